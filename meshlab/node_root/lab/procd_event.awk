# Stand-in for procd, evaluation of `ubus call service event`: the triggers of all services (JSON, one file each, the last set
# service first) and the event -> one line "DELAY_MS WORD WORD..." (tab-separated) per run_script that the event
# triggers.
function truth(path,    n, list, i) {
	n = split(substr(members[path], 2), list, "\t")
	kind = value[path "/0"]
	if (kind == "eq" || kind == "has" || kind == "regex") {
		name = value[path "/1"]
		if (!(name in data)) return 0
		if (kind == "has") return 1
		return kind == "eq" ? data[name] == value[path "/2"] : data[name] ~ value[path "/2"]
	}
	if (kind == "not") return !truth(path "/1")
	if (kind == "and") { for (i = 2; i <= n; i++) if (!truth(path "/" list[i])) return 0; return 1 }
	if (kind == "or") { for (i = 2; i <= n; i++) if (truth(path "/" list[i])) return 1; return 0 }
	return 0
}
function run(path, delay,    n, list, i, line) {
	n = split(substr(members[path], 2), list, "\t")
	# a list of statements
	if (sort[path "/0"] == "a") { for (i = 1; i <= n; i++) run(path "/" list[i], delay); return }
	if (value[path "/0"] == "if") {
		if (truth(path "/1")) run(path "/2", delay)
		else if (n > 3) run(path "/3", delay)
	} else if (value[path "/0"] == "run_script") {
		line = delay
		for (i = 2; i <= n; i++) line = line "\t" value[path "/" list[i]]
		print line
	}
}
function matches(type, pattern,    at) {
	at = index(pattern, ".*")
	return at ? substr(type, 1, at - 1) == substr(pattern, 1, at - 1) : type == pattern
}
function forget() { split("", value); split("", members); split("", sort) }
BEGIN {
	if (!json(event) || !("/type" in value) || !("/data" in members)) exit 2
	type = value["/type"]
	n = split(substr(members["/data"], 2), names, "\t")
	for (i = 1; i <= n; i++) data[names[i]] = value["/data/" names[i]]
	for (f = 1; f < ARGC; f++) {
		text = ""
		while ((getline line < ARGV[f]) > 0) text = text line "\n"
		close(ARGV[f])
		forget()
		if (!json(text)) continue
		n = split(substr(members[""], 2), list, "\t")
		# the last added comes first
		for (i = n; i; i--) if (matches(type, value["/" list[i] "/0"])) run("/" list[i] "/1", value["/" list[i] "/2"] + 0)
	}
	exit 0
}

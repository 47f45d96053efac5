# Stand-in for procd, parser of `ubus call service set|add`: JSON on standard input -> the directory `out`:
#   name, script (one line each); triggers, only if given: the JSON array;
#   instances/NAME/command: one word per line; instances/NAME/env: one NAME=VALUE per line;
#   instances/NAME/settings: one KEY VALUE per line; instances/NAME/files: checksums
# Fails without a name.
function put(file, text) { printf "%s", text > (out "/" file); close(out "/" file) }
function each(path, between,    n, i, list, text) {
	n = split(substr(members[path], 2), list, "\t")
	text = ""
	for (i = 1; i <= n; i++) text = text (sort[path] == "o" ? list[i] between : "") value[path "/" list[i]] "\n"
	return text
}
# in the replacement of gsub, "\\\\&" is a backslash and what was found in every busybox; "\\" is not
function quoted(text) { gsub(/'/, "'\\\\&'", text); return "'" text "'" }
{ text = text $0 "\n" }
END {
	if (!json(text) || !("/name" in value)) exit 1
	system("mkdir -p " quoted(out) "/instances")
	put("name", value["/name"] "\n")
	if ("/script" in value) put("script", value["/script"] "\n")
	if ("/triggers" in members) put("triggers", json_shown("/triggers") "\n")
	if ("/instances" in members) put("has_instances", "")
	n = split(substr(members["/instances"], 2), names, "\t")
	for (i = 1; i <= n; i++) {
		at = "/instances/" names[i]
		system("mkdir -p " quoted(out at))
		put(substr(at, 2) "/command", each(at "/command", ""))
		put(substr(at, 2) "/env", each(at "/env", "="))
		settings = "term_timeout " ((at "/term_timeout") in value ? value[at "/term_timeout"] : 5) "\n"
		if ((at "/respawn") in members) {
			split(each(at "/respawn", " "), three, "\n")
			settings = settings "respawn " (three[1] == "" ? 3600 : three[1] + 0) " " (three[2] == "" ? 5 : three[2] + 0) " " (three[3] == "" ? 5 : three[3] + 0) "\n"
		}
		if (value[at "/stdout"]) settings = settings "stdout 1\n"
		if (value[at "/stderr"]) settings = settings "stderr 1\n"
		if ((at "/pidfile") in value) settings = settings "pidfile " value[at "/pidfile"] "\n"
		if ((at "/reload_signal") in value) settings = settings "reload_signal " value[at "/reload_signal"] "\n"
		put(substr(at, 2) "/settings", settings)
		sums = ""
		m = split(each(at "/file", ""), files, "\n")
		for (j = 1; j < m; j++) {
			command = "md5sum " quoted(files[j]) " 2>/dev/null"
			line = ""
			command | getline line
			close(command)
			sums = sums (line == "" ? "absent " files[j] : line) "\n"
		}
		put(substr(at, 2) "/files", sums)
	}
	exit 0
}

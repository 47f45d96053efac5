# Stand-in for OpenWrt's uci, the commands; uci_tree.awk is run together with this file.

# --- commands --------------------------------------------------------------------------------------------------------

function all_packages(out,    n, name, command) {
	command = "cd " DIR " 2>/dev/null && ls -A"
	n = 0
	while ((command | getline name) > 0) if (name !~ /^\./) out[++n] = name
	close(command)
	return n
}

# the id of `name` or `@type[n]`, "" when there is none
function find_section(pkg, text,    type, wanted, n, count) {
	if (text !~ /^@/) return (pkg, text) in TYPE ? text : ""
	if (text !~ /^@[^[]*\[-?[0-9]+\]$/) return ""
	type = text; sub(/^@/, "", type); sub(/\[.*/, "", type)
	wanted = text; sub(/^[^[]*\[/, "", wanted); sub(/\]$/, "", wanted); wanted += 0
	count = 0
	for (n = 1; n <= NSEC[pkg]; n++) if (type == "" || TYPE[pkg, SEC[pkg, n]] == type) FOUND[count++] = SEC[pkg, n]
	if (wanted < 0) wanted += count
	return wanted >= 0 && wanted < count ? FOUND[wanted] : ""
}

# its name in `show`: @type[n] for an anonymous section
function shown(pkg, id,    n, count) {
	if (!ANON[pkg, id] || EXTENDED == 0) return id
	count = 0
	for (n = 1; n <= NSEC[pkg] && SEC[pkg, n] != id; n++) if (TYPE[pkg, SEC[pkg, n]] == TYPE[pkg, id]) count++
	return "@" TYPE[pkg, id] "[" count "]"
}

function value_text(pkg, id, option, quote,    text, j, item) {
	if (!LIST[pkg, id, option]) return quote ? quoted(VAL[pkg, id, option]) : VAL[pkg, id, option]
	text = ""
	for (j = 1; j <= LIST[pkg, id, option]; j++) {
		item = ITEM[pkg, id, option, j]
		text = text (j > 1 ? DELIMITER : "") (quote || index(item, DELIMITER) ? quoted(item) : item)
	}
	return text
}

function show_section(pkg, id,    k, name) {
	name = pkg "." shown(pkg, id)
	print name "=" TYPE[pkg, id]
	for (k = 1; k <= NOPT[pkg, id]; k++) print name "." OPT[pkg, id, k] "=" value_text(pkg, id, OPT[pkg, id, k], 1)
}

function show(path,    part, n, id, names, count) {
	if (path == "") {
		count = all_packages(names)
		for (n = 1; n <= count; n++) { if (!load(names[n])) return 0; show(names[n]) }
		return 1
	}
	n = dotted(path, part)
	if (!load(part[1])) return 0
	if (n == 1) { for (n = 1; n <= NSEC[part[1]]; n++) show_section(part[1], SEC[part[1], n]); return 1 }
	id = find_section(part[1], part[2])
	if (id == "") return fail("Entry not found")
	if (n == 2) { show_section(part[1], id); return 1 }
	if (!((part[1], id, part[3]) in HAS)) return fail("Entry not found")
	print part[1] "." shown(part[1], id) "." part[3] "=" value_text(part[1], id, part[3], 1)
	return 1
}

function get(path,    part, n, id) {
	n = dotted(path, part)
	if (n < 2) return fail("Invalid argument")
	if (!load(part[1])) return 0
	id = find_section(part[1], part[2])
	if (id == "") return fail("Entry not found")
	if (n == 2) { print TYPE[part[1], id]; return 1 }
	if (!((part[1], id, part[3]) in HAS)) return fail("Entry not found")
	print value_text(part[1], id, part[3], 0)
	return 1
}

function dotted(path, part,    n) {
	delete part
	n = split(path, part, ".")
	return n > 3 ? 0 : n
}

# parse PACKAGE.SECTION[.OPTION][=VALUE] of a modifying command; 0 after an error
function target(text, needs_value, out,    at, part, n) {
	at = index(text, "=")
	if (needs_value && !at) return fail("Invalid argument")
	out["value"] = at ? substr(text, at + 1) : ""
	out["given"] = at > 0
	n = dotted(at ? substr(text, 1, at - 1) : text, part)
	if (n < 2) return fail("Invalid argument")
	out["pkg"] = part[1]; out["section"] = part[2]; out["option"] = part[3]; out["n"] = n
	if (!load(part[1])) return 0
	out["id"] = find_section(part[1], part[2])
	return 1
}

function edit(verb, text,    t, path) {
	if (!target(text, verb ~ /^(set|add_list|del_list|rename|reorder)$/, t)) return 0
	path = t["pkg"] "." (t["id"] == "" ? t["section"] : t["id"])
	if (verb == "set" && t["n"] == 2 && t["id"] == "") {
		if (!valid(t["section"]) || t["value"] == "") return fail("Invalid argument")
		change(t["pkg"], "=", path, t["value"], 1)
		return 1
	}
	if (t["id"] == "") return fail(verb == "set" || verb == "add_list" ? "Invalid argument" : "Entry not found")
	if (t["n"] == 3) {
		if (!valid(t["option"])) return fail("Invalid argument")
		path = path "." t["option"]
		if (verb != "set" && verb != "add_list" && !((t["pkg"], t["id"], t["option"]) in HAS)) return fail("Entry not found")
	}
	if (verb == "set" && t["value"] == "") change(t["pkg"], "-", path, "", 0)
	else if (verb == "set") change(t["pkg"], "=", path, t["value"], 1)
	else if (verb == "delete") change(t["pkg"], "-", path, "", 0)
	else if (verb == "add_list") change(t["pkg"], "|", path, t["value"], 1)
	else if (verb == "del_list") change(t["pkg"], "~", path, t["value"], 1)
	else if (verb == "rename") change(t["pkg"], "@", path, t["value"], 1)
	else if (verb == "reorder") change(t["pkg"], "^", path, t["value"], 1)
	return 1
}

function add(pkg, type,    id) {
	if (!load(pkg)) return 0
	id = sprintf("cfg%02x%04x", NSEC[pkg] + 1, djb(type, 5381) % 65536)
	change(pkg, "+", pkg "." id, type, 1)
	print id
	return 1
}

function changes(pkg,    names, count, n, k, line, sign, command) {
	if (pkg == "") {
		command = "cd " SAVE " 2>/dev/null && ls -A"
		count = 0
		while ((command | getline line) > 0) if (exists(DIR "/" line)) names[++count] = line
		close(command)
		for (n = 1; n <= count; n++) changes(names[n])
		return 1
	}
	if (!load(pkg)) return 0
	for (k = 1; k <= NDELTA[pkg]; k++) {
		line = DELTA[pkg, k]
		sign = substr(line, 1, 1)
		if (sign ~ /[+@^|~]/) line = substr(line, 2)
		if (sign == "|") sub(/=/, "+=", line)
		if (sign == "~") sub(/=/, "-=", line)
		print line
	}
	return 1
}

# packages with a delta, or the one named
function changed_packages(pkg, out,    n, command, line) {
	if (pkg != "") { out[1] = pkg; sub(/\..*/, "", out[1]); return 1 }
	n = 0
	command = "cd " SAVE " 2>/dev/null && ls -A"
	while ((command | getline line) > 0) if (exists(DIR "/" line)) out[++n] = line
	close(command)
	for (line in NEW) if (NEW[line] != "" && !exists(SAVE "/" line)) out[++n] = line
	return n
}

function commit(pkg,    names, n, count) {
	count = changed_packages(pkg, names)
	for (n = 1; n <= count; n++) {
		if (!load(names[n])) return 0
		if (!NDELTA[names[n]]) continue
		if (!write_config(names[n])) return 0
		forget(names[n])
	}
	return 1
}

function forget(pkg) {
	NEW[pkg] = ""; NDELTA[pkg] = 0
	if (exists(SAVE "/" pkg)) system("rm -f " SAVE "/" pkg)
}

# the whole package, or one section or option of it
function revert(path,    names, n, count, part, k, kept, line) {
	if (path ~ /\./) {
		dotted(path, part)
		if (!load(part[1])) return 0
		sub(/^[^.]*\./, "", path)
		n = find_section(part[1], part[2])
		path = part[1] "." (n == "" ? part[2] : n) (part[3] == "" ? "" : "." part[3])
		kept = ""
		for (k = 1; k <= NDELTA[part[1]]; k++) {
			line = DELTA[part[1], k]; sub(/^[-+@^|~]/, "", line); sub(/=.*/, "", line)
			if (line != path && index(line, path ".") != 1) kept = kept DELTA[part[1], k] "\n"
		}
		forget(part[1]); delete LOADED[part[1]]
		NEW[part[1]] = kept
		return 1
	}
	count = changed_packages(path, names)
	for (n = 1; n <= count; n++) { forget(names[n]); clear(names[n]) }
	return 1
}

function clear(pkg) {
	while (NSEC[pkg] > 0) drop_section(pkg, SEC[pkg, 1])
	delete LOADED[pkg]
}

function export_package(pkg,    names, n, count) {
	if (pkg == "") {
		count = all_packages(names)
		for (n = 1; n <= count; n++) if (!export_package(names[n])) return 0
		return 1
	}
	if (!load(pkg)) return 0
	printf "package %s\n%s", pkg, config_text(pkg)
	return 1
}

# replace the package by text from standard input and commit it; `package NAME` lines name further packages
function import_line(line) { IMPORT = IMPORT line "\n" }

function import_end(pkg,    temporary, status) {
	temporary = "/tmp/.uci-import-" pkg
	printf "%s", IMPORT > temporary
	close(temporary)
	if (!MERGE) { clear(pkg) } else load(pkg)
	LOADED[pkg] = 1
	status = read_config(temporary, pkg)
	system("rm -f " temporary)
	if (status <= 0) return 0
	if (!write_config(pkg)) return 0
	forget(pkg)
	return 1
}

function run(verb, a, b) {
	if (verb == "show") return show(a)
	if (verb == "get") return get(a)
	if (verb == "set" || verb == "add_list" || verb == "del_list" || verb == "rename" || verb == "reorder") return edit(verb, a)
	if (verb == "delete" || verb == "del") return edit("delete", a)
	if (verb == "add") return add(a, b)
	if (verb == "changes") return changes(a)
	if (verb == "commit") return commit(a)
	if (verb == "revert") return revert(a)
	if (verb == "export") return export_package(a)
	return fail("Invalid argument")
}

BEGIN {
	DIR = "/etc/config"; SAVE = "/tmp/.uci"; DELIMITER = " "; EXTENDED = 1
	for (i = 1; i < ARGC && ARGV[i] ~ /^-./; i++) {
		flag = ARGV[i]
		if (flag == "-q") QUIET = 1
		else if (flag == "-c") DIR = ARGV[++i]
		else if (flag == "-d") DELIMITER = ARGV[++i]
		else if (flag == "-P" || flag == "-t") SAVE = ARGV[++i]
		else if (flag == "-p" || flag == "-f") FILE[flag] = ARGV[++i]
		else if (flag == "-X") EXTENDED = 0
		else if (flag == "-m") MERGE = 1
		else if (flag !~ /^-[nNsS]$/) usage()
	}
	verb = ARGV[i++]
	if (verb == "") usage()
	first = ARGV[i]; second = ARGV[i + 1]; rest = i
	count = ARGC
	if (verb == "batch" || verb == "import") {
		ARGC = 1
		if ("-f" in FILE) { ARGC = 2; ARGV[1] = FILE["-f"] }
		reading = 1
	} else {
		if (verb ~ /^(get|set|add_list|del_list|delete|del|rename|reorder)$/ && first == "") usage()
		if (verb ~ /^(set|add_list|del_list|delete|del|rename|reorder)$/) { for (i = rest; i < count; i++) if (!run(verb, ARGV[i])) break }
		else run(verb, first, second)
		exit
	}
}

verb == "import" { import_line($0); next }

{
	n = tokens(pending $0, word)
	if (n < 0) { pending = pending $0 "\n"; next }
	pending = ""
	if (n == 0) next
	if (n > 3 && word[1] != "set") { fail("Invalid argument"); next }
	for (i = n + 1; i <= 3; i++) word[i] = ""
	if (word[1] == "exit") exit
	run(word[1], word[2], word[3])
}

END {
	if (verb == "import" && reading && !import_end(first)) FAILED = 1
	save_deltas()
	exit FAILED
}

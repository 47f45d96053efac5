# Stand-in for OpenWrt's uci, the tree: configuration files in /etc/config, uncommitted changes as deltas in /tmp/.uci.
# The commands are in uci.awk, which runs together with this file.
#
# arguments -> commands (from the command line, or one per line with `batch`) -> load(package), its delta applied
#   -> change in memory, one delta line per change -> `commit` writes the file
#
# A section is SEC[pkg, n] = id, an option OPT[pkg, id, k] = name; TYPE, ANON, VAL, LIST, ITEM hang off these.
# Not supported: -l, -t; locking; `import -m` merges by sections.

function fail(text, status) {
	if (!QUIET) print "uci: " text > "/dev/stderr"
	FAILED = status ? status : 1
	return 0
}

function usage() { print "Usage: uci [<options>] <command> [<arguments>]" > "/dev/stderr"; exit 255 }

# --- tokens: words, 'single', "double" quotes, \ escapes; a quote may run over lines ---------------------------------

function tokens(text, out,    n, c, word, has, quote, i, len) {
	n = 0; word = ""; has = 0; quote = ""; len = length(text)
	for (i = 1; i <= len; i++) {
		c = substr(text, i, 1)
		if (quote == "'") { if (c == "'") quote = ""; else word = word c }
		else if (quote == "\"") {
			if (c == "\"") quote = ""
			else if (c == "\\") word = word substr(text, ++i, 1)
			else word = word c
		}
		else if (c == "'" || c == "\"") { quote = c; has = 1 }
		else if (c == "\\") { word = word substr(text, ++i, 1); has = 1 }
		else if (c ~ /[ \t\r\n]/) { if (has) { out[++n] = word; word = ""; has = 0 } }
		else if (c == "#" && !has) break
		else { word = word c; has = 1 }
	}
	if (quote != "") { OPEN = quote; return -1 }
	if (has) out[++n] = word
	return n
}

# the common line `option name 'value'` without escapes is split at once
function quick(line, out) {
	if (line !~ /^[ \t]*(option|list|config)[ \t]+[A-Za-z0-9_-]+[ \t]+'[^'\\]*'[ \t]*$/) return 0
	sub(/^[ \t]+/, "", line)
	out[1] = line; sub(/[ \t].*/, "", out[1])
	out[2] = substr(line, length(out[1]) + 1); sub(/^[ \t]+/, "", out[2])
	out[3] = out[2]; sub(/[ \t].*/, "", out[2])
	sub(/^[^']*'/, "", out[3]); sub(/'[ \t]*$/, "", out[3])
	return 3
}

# in the replacement of gsub, "\\\\&" is a backslash and what was found in every busybox; "\\" is not
function quoted(value) { gsub(/'/, "'\\\\&'", value); return "'" value "'" }

function valid(name) { return name ~ /^[A-Za-z0-9_]+$/ }

# --- the tree --------------------------------------------------------------------------------------------------------

function djb(text, hash,    i) {
	if (!(1 in ORD)) { ORD[1] = 1; for (i = 1; i < 256; i++) ORD[sprintf("%c", i)] = i }
	for (i = 1; i <= length(text); i++) hash = (hash * 33 + ORD[substr(text, i, 1)]) % 2147483648
	return hash
}

# libuci's name of an anonymous section: position and a hash of type and options
function name_section(pkg, id, position,    hash, k) {
	hash = djb(TYPE[pkg, id], 5381)
	for (k = 1; k <= NOPT[pkg, id]; k++) if (!LIST[pkg, id, OPT[pkg, id, k]]) {
		hash = djb(VAL[pkg, id, OPT[pkg, id, k]], djb(OPT[pkg, id, k], hash))
	}
	return sprintf("cfg%02x%04x", position, hash % 65536)
}

function add_section(pkg, type, name,    id) {
	id = name
	if (name != "" && (pkg, name) in TYPE) { TYPE[pkg, name] = type; return name }
	if (name == "") id = "\001" (++SERIAL)
	SEC[pkg, ++NSEC[pkg]] = id
	TYPE[pkg, id] = type
	ANON[pkg, id] = name == ""
	return id
}

function position_of(pkg, id,    n) { for (n = 1; n <= NSEC[pkg]; n++) if (SEC[pkg, n] == id) return n; return 0 }

# give an anonymous section its libuci name, once it is complete
function settle(pkg, id,    name, k, j, option) {
	if (id !~ /^\001/) return id
	name = name_section(pkg, id, position_of(pkg, id))
	rename_section(pkg, id, name)
	ANON[pkg, name] = 1
	return name
}

function rename_section(pkg, id, name,    k, j, option) {
	SEC[pkg, position_of(pkg, id)] = name
	TYPE[pkg, name] = TYPE[pkg, id]; ANON[pkg, name] = 0; NOPT[pkg, name] = NOPT[pkg, id]
	for (k = 1; k <= NOPT[pkg, id]; k++) {
		option = OPT[pkg, id, k]
		OPT[pkg, name, k] = option; HAS[pkg, name, option] = 1
		VAL[pkg, name, option] = VAL[pkg, id, option]; LIST[pkg, name, option] = LIST[pkg, id, option]
		for (j = 1; j <= LIST[pkg, id, option]; j++) ITEM[pkg, name, option, j] = ITEM[pkg, id, option, j]
		delete HAS[pkg, id, option]
	}
	delete TYPE[pkg, id]; NOPT[pkg, id] = 0
}

function drop_section(pkg, id,    n, k) {
	for (n = position_of(pkg, id); n < NSEC[pkg]; n++) SEC[pkg, n] = SEC[pkg, n + 1]
	NSEC[pkg]--
	for (k = 1; k <= NOPT[pkg, id]; k++) delete HAS[pkg, id, OPT[pkg, id, k]]
	NOPT[pkg, id] = 0
	delete TYPE[pkg, id]
}

function set_option(pkg, id, option, value) {
	if (!((pkg, id, option) in HAS)) { OPT[pkg, id, ++NOPT[pkg, id]] = option; HAS[pkg, id, option] = 1 }
	VAL[pkg, id, option] = value
	LIST[pkg, id, option] = 0
}

function add_item(pkg, id, option, value) {
	if (!((pkg, id, option) in HAS)) { OPT[pkg, id, ++NOPT[pkg, id]] = option; HAS[pkg, id, option] = 1; LIST[pkg, id, option] = 0 }
	else if (!LIST[pkg, id, option]) { LIST[pkg, id, option] = 1; ITEM[pkg, id, option, 1] = VAL[pkg, id, option] }
	ITEM[pkg, id, option, ++LIST[pkg, id, option]] = value
}

function drop_item(pkg, id, option, value,    j, kept) {
	kept = 0
	for (j = 1; j <= LIST[pkg, id, option]; j++) if (ITEM[pkg, id, option, j] != value) ITEM[pkg, id, option, ++kept] = ITEM[pkg, id, option, j]
	if (LIST[pkg, id, option] && !kept) drop_option(pkg, id, option)
	else LIST[pkg, id, option] = kept
}

function drop_option(pkg, id, option,    k) {
	for (k = 1; k <= NOPT[pkg, id]; k++) if (OPT[pkg, id, k] == option) break
	for (; k < NOPT[pkg, id]; k++) OPT[pkg, id, k] = OPT[pkg, id, k + 1]
	NOPT[pkg, id]--
	delete HAS[pkg, id, option]
}

function reorder(pkg, id, place,    n, from) {
	from = position_of(pkg, id)
	place = place + 1
	if (place > NSEC[pkg]) place = NSEC[pkg]
	for (n = from; n < place; n++) SEC[pkg, n] = SEC[pkg, n + 1]
	for (n = from; n > place; n--) SEC[pkg, n] = SEC[pkg, n - 1]
	SEC[pkg, place] = id
}

# --- files -----------------------------------------------------------------------------------------------------------

function parse_error(what, at) { return fail("Parse error (" what ") at line " at ", byte 0") }

# read a configuration text from `file` into pkg; 0 after an error, which is reported
function read_config(file, pkg,    line, part, n, id, number, text, status) {
	id = ""; number = 0
	while ((status = (getline line < file)) > 0) {
		number++
		if (line ~ /^[ \t]*(#|$)/) continue
		n = quick(line, part)
		if (!n) {
			text = line
			while ((n = tokens(text, part)) < 0 && (getline line < file) > 0) { text = text "\n" line; number++ }
			if (n < 0) { close(file); return parse_error("EOF with unterminated " OPEN, number) }
			if (!n) continue
		}
		if (!take_line(pkg, part, n, number, id)) { close(file); return 0 }
		id = CURRENT
	}
	close(file)
	if (status < 0) return -1
	if (id != "") settle(pkg, id)
	return 1
}

function take_line(pkg, part, n, number, id) {
	CURRENT = id
	if (part[1] == "package") return 1
	if (part[1] == "config") {
		if (n < 2 || n > 3) return parse_error("too " (n < 2 ? "few" : "many") " arguments", number)
		if (n == 3 && part[3] != "" && !valid(part[3])) return parse_error("invalid character in name field", number)
		if (id != "") settle(pkg, id)
		CURRENT = add_section(pkg, part[2], n == 3 ? part[3] : "")
		return 1
	}
	if (part[1] != "option" && part[1] != "list") return parse_error("invalid command", number)
	if (id == "") return parse_error("option/list command found before the first section", number)
	if (n != 3) return parse_error("too " (n < 3 ? "few" : "many") " arguments", number)
	if (!valid(part[2])) return parse_error("invalid character in name field", number)
	if (part[1] == "list") add_item(pkg, id, part[2], part[3])
	else set_option(pkg, id, part[2], part[3])
	return 1
}

function exists(file,    line, status) { status = (getline line < file); close(file); return status >= 0 }

# 1 when the package is there and well formed; its delta is applied, except on `commit`'s own reading of changes
function load(pkg,    status) {
	if (pkg in LOADED) return LOADED[pkg]
	if (pkg !~ /^[A-Za-z0-9_.-]+$/ || !exists(DIR "/" pkg)) { LOADED[pkg] = 0; return fail("Entry not found") }
	status = read_config(DIR "/" pkg, pkg)
	LOADED[pkg] = status > 0
	if (status > 0) read_delta(pkg)
	return LOADED[pkg]
}

function read_delta(pkg,    line, text, n, part, file, sign) {
	file = SAVE "/" pkg
	while ((getline line < file) > 0) {
		text = line
		while ((n = tokens(text, part)) < 0 && (getline line < file) > 0) text = text "\n" line
		if (n < 1) continue
		DELTA[pkg, ++NDELTA[pkg]] = text
		sign = substr(part[1], 1, 1)
		if (sign ~ /[-+@^|~]/) part[1] = substr(part[1], 2); else sign = "="
		replay(pkg, sign, part[1])
	}
	close(file)
}

# apply one delta (`pkg.sec.opt=value`) to the tree
function replay(pkg, sign, text,    path, value, at, part, n, id) {
	at = index(text, "=")
	path = at ? substr(text, 1, at - 1) : text
	value = at ? substr(text, at + 1) : ""
	n = split(path, part, ".")
	id = part[2]
	if (sign == "+" ) { add_section(pkg, value, id); ANON[pkg, id] = 1; return }
	if (n == 2 && sign == "=") { add_section(pkg, value, id); return }
	if (!((pkg, id) in TYPE)) return
	if (sign == "-" && n == 2) drop_section(pkg, id)
	else if (sign == "-") { if ((pkg, id, part[3]) in HAS) { if (value != "") drop_item(pkg, id, part[3], value); else drop_option(pkg, id, part[3]) } }
	else if (sign == "@" && n == 2) rename_section(pkg, id, value)
	else if (sign == "@") { if ((pkg, id, part[3]) in HAS) rename_option(pkg, id, part[3], value) }
	else if (sign == "^") reorder(pkg, id, value)
	else if (sign == "|") add_item(pkg, id, part[3], value)
	else if (sign == "~") drop_item(pkg, id, part[3], value)
	else set_option(pkg, id, part[3], value)
}

function rename_option(pkg, id, option, name,    k, j) {
	for (k = 1; k <= NOPT[pkg, id]; k++) if (OPT[pkg, id, k] == option) OPT[pkg, id, k] = name
	HAS[pkg, id, name] = 1; VAL[pkg, id, name] = VAL[pkg, id, option]; LIST[pkg, id, name] = LIST[pkg, id, option]
	for (j = 1; j <= LIST[pkg, id, option]; j++) ITEM[pkg, id, name, j] = ITEM[pkg, id, option, j]
	delete HAS[pkg, id, option]
}

function change(pkg, sign, path, value, has_value,    text) {
	text = (sign == "=" ? "" : sign) path (has_value ? "=" quoted(value) : "")
	DELTA[pkg, ++NDELTA[pkg]] = text
	NEW[pkg] = NEW[pkg] text "\n"
	replay(pkg, sign, path (has_value ? "=" value : ""))
}

# changes outlive the process as deltas; flushed at the end
function save_deltas(    pkg, made) {
	for (pkg in NEW) if (NEW[pkg] != "") {
		if (!made) { system("mkdir -p " SAVE); made = 1 }
		printf "%s", NEW[pkg] >> (SAVE "/" pkg)
		close(SAVE "/" pkg)
	}
}

function config_text(pkg,    n, k, j, id, option, text) {
	text = ""
	for (n = 1; n <= NSEC[pkg]; n++) {
		id = SEC[pkg, n]
		text = text "\nconfig " TYPE[pkg, id] (ANON[pkg, id] ? "" : " '" id "'") "\n"
		for (k = 1; k <= NOPT[pkg, id]; k++) {
			option = OPT[pkg, id, k]
			if (LIST[pkg, id, option]) for (j = 1; j <= LIST[pkg, id, option]; j++) text = text "\tlist " option " " quoted(ITEM[pkg, id, option, j]) "\n"
			else text = text "\toption " option " " quoted(VAL[pkg, id, option]) "\n"
		}
	}
	return text "\n"
}

function write_config(pkg,    temporary) {
	temporary = DIR "/." pkg ".uci-" PKGS++
	printf "%s", config_text(pkg) > temporary
	close(temporary)
	if (system("chmod 600 " temporary "; mv -f " temporary " " DIR "/" pkg)) return fail("I/O error")
	return 1
}

# JSON text as flat values: json(text) fills `value[path]` and `sort[path]` ("s"tring, "n"umber, "b"oolean, "o"bject,
# "a"rray) and, for objects and arrays, `members[path]`: their keys or indices, each after a tab, in order. A path is the
# keys from the root, each after a "/". Returns 0 for text that is not JSON.

function json(text) {
	json_text = text; json_bad = 0
	json_any("")
	json_blank()
	return !json_bad && json_text == ""
}
function json_blank() { sub(/^[ \t\r\n]+/, "", json_text) }
function json_take(length_) { json_text = substr(json_text, length_ + 1) }
function json_string(    c, text) {
	json_take(1)
	text = ""
	while (match(json_text, /^[^"\\]*/)) {
		text = text substr(json_text, 1, RLENGTH)
		json_take(RLENGTH)
		c = substr(json_text, 1, 1)
		if (c == "\"") { json_take(1); return text }
		if (c == "") { json_bad = 1; return text }
		c = substr(json_text, 2, 1)
		text = text (c == "n" ? "\n" : c == "t" ? "\t" : c == "r" ? "\r" : c)
		json_take(2)
	}
	return text
}
function json_any(path,    c, key, n) {
	json_blank()
	c = substr(json_text, 1, 1)
	if (c == "{" || c == "[") {
		sort[path] = c == "{" ? "o" : "a"
		members[path] = ""
		json_take(1); json_blank()
		if (substr(json_text, 1, 1) == (c == "{" ? "}" : "]")) { json_take(1); return }
		n = 0
		while (!json_bad) {
			json_blank()
			if (c == "{") {
				if (substr(json_text, 1, 1) != "\"") { json_bad = 1; return }
				key = json_string(); json_blank()
				if (substr(json_text, 1, 1) != ":") { json_bad = 1; return }
				json_take(1)
			} else key = n++
			members[path] = members[path] "\t" key
			json_any(path "/" key); json_blank()
			if (substr(json_text, 1, 1) == ",") { json_take(1); continue }
			if (substr(json_text, 1, 1) != (c == "{" ? "}" : "]")) json_bad = 1
			json_take(1)
			return
		}
	} else if (c == "\"") { sort[path] = "s"; value[path] = json_string() }
	else if (match(json_text, /^(true|false|null)/)) { sort[path] = "b"; value[path] = substr(json_text, 1, RLENGTH) == "true"; json_take(RLENGTH) }
	else if (match(json_text, /^-?[0-9][0-9.eE+-]*/)) { sort[path] = "n"; value[path] = substr(json_text, 1, RLENGTH); json_take(RLENGTH) }
	else json_bad = 1
}
# in the replacement of gsub, "\\\\&" is a backslash and what was found in every busybox; "\\" is not
function json_quoted(text,    n, i, line) {
	gsub(/["\\]/, "\\\\&", text)
	n = split(text, line, "\n"); text = line[1]
	for (i = 2; i <= n; i++) text = text "\\n" line[i]
	return "\"" text "\""
}
# the same value as JSON text
function json_shown(path,    n, i, list, text) {
	if (sort[path] == "s") return json_quoted(value[path])
	if (sort[path] == "b") return value[path] ? "true" : "false"
	if (sort[path] == "n") return value[path]
	n = split(substr(members[path], 2), list, "\t")
	text = ""
	for (i = 1; i <= n; i++) text = text (i > 1 ? ", " : " ") (sort[path] == "o" ? "\"" list[i] "\": " : "") json_shown(path "/" list[i])
	return (sort[path] == "o" ? "{" : "[") text (n ? " " : "") (sort[path] == "o" ? "}" : "]")
}

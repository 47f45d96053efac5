# Stand-in for procd, output of `ubus call service list`: the directory of one service and its instances, as netifd-style
# JSON. Variables: name, at (its directory), verbose, first (no service before it).
function lines(file,    n, line) {
	split("", got)
	n = 0
	while ((getline line < file) > 0) got[++n] = line
	close(file)
	return n
}
# in the replacement of gsub, "\\\\&" is a backslash and what was found in every busybox; "\\" is not
function text(word) { gsub(/["\\]/, "\\\\&", word); return "\"" word "\"" }
BEGIN {
	if (!first) print ","
	printf "\t%s: {\n", text(name)
	n = split(instances, list, " ")
	if (n) {
		printf "\t\t\"instances\": {\n"
		for (i = 1; i <= n; i++) {
			dir = at "/instances/" list[i]
			pid = lines(dir "/pid") ? got[1] : ""
			printf "\t\t\t%s: {\n\t\t\t\t\"running\": %s,\n", text(list[i]), (pid == "" ? "false" : "true")
			if (pid != "") printf "\t\t\t\t\"pid\": %d,\n", pid
			printf "\t\t\t\t\"command\": ["
			m = lines(dir "/command")
			for (j = 1; j <= m; j++) printf "%s\n\t\t\t\t\t%s", (j > 1 ? "," : ""), text(got[j])
			printf "\n\t\t\t\t],\n"
			m = lines(dir "/settings")
			term = 5; respawn = ""; pidfile = ""
			for (j = 1; j <= m; j++) {
				split(got[j], word, " ")
				if (word[1] == "term_timeout") term = word[2]
				if (word[1] == "pidfile") pidfile = word[2]
				if (word[1] == "respawn") respawn = sprintf("\"respawn\": {\n\t\t\t\t\t\"threshold\": %d,\n\t\t\t\t\t\"timeout\": %d,\n\t\t\t\t\t\"retry\": %d\n\t\t\t\t}", word[2], word[3], word[4])
			}
			printf "\t\t\t\t\"term_timeout\": %d", term
			if (pid == "") printf ",\n\t\t\t\t\"exit_code\": %d", (lines(dir "/exit_code") ? got[1] : 0)
			if (respawn != "" && (getline line < (dir "/crashed")) <= 0) printf ",\n\t\t\t\t%s", respawn
			if (pidfile != "") printf ",\n\t\t\t\t\"pidfile\": %s", text(pidfile)
			printf "\n\t\t\t}%s\n", (i < n ? "," : "")
		}
		printf "\t\t}"
	}
	if (verbose && lines(at "/triggers")) printf "%s\t\t\"triggers\": %s", (n ? ",\n" : ""), got[1]
	printf "\n\t}"
	exit 0
}

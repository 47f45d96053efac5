# Prints the links of a node's mesh radios and its paths, as few bytes as possible. `N` is a nonce no output can contain,
# `ROWS` a pattern of lines in the table of originators; both may be set before. Without `N`, each line of standard input
# is a nonce and is answered. Sections as in observe.sh. Nothing here changes the node.
ROWS=${ROWS:-'^ *[*] '}

section() { # NAME COMMAND...
	printf '%s begin %s\n' "$N" "$1"
	shift
	"$@" 2>/dev/null
	printf '\n%s end %s\n' "$N" $?
}

stations() { # INTERFACE
	iw dev "$1" station dump | grep -E '^Station|inactive time:|signal:|signal avg:|expected throughput:|mesh plink:'
}

survey() { # INTERFACE
	iw dev "$1" survey dump | awk '/^Survey/ { head = $0 } /frequency:/ { used = /\[in use\]/; if (used) print head } used && /frequency:|noise:/'
}

# the table of BATMAN_IV and BATMAN_V, of the wanted rows alone; before 2020 batctl has no meshif
path() { # INTERFACE
	{ batctl meshif "$1" originators 2>/dev/null || batctl -m "$1" originators; } | grep -iE "Originator|$ROWS"
}

links() {
	for dev in $(iw dev 2>/dev/null | awk '$1 == "Interface" { name = $2 } $1 == "type" && ($2 == "IBSS" || $2 == "mesh") { print name }'); do
		section "iw.stations $dev" stations "$dev"
		section "iw.survey $dev" survey "$dev"
	done
	for dev in /sys/class/net/bat*; do
		[ ! -e "$dev" ] || section "batctl.path ${dev##*/}" path "${dev##*/}"
	done
	section done true
}

if [ -n "${N:-}" ]; then
	links
else
	while read -r N; do links </dev/null; done
fi

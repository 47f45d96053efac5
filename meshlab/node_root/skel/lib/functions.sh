# Stand-in for OpenWrt's /lib/functions.sh: reading UCI from shell, as far as common init scripts need.
config_load() {
	CONFIG_PACKAGE=$1
	CONFIG_SECTIONS=
	eval "$(uci -q -X show "$1" | awk '
		{
			at = index($0, "="); path = substr($0, 1, at - 1); value = substr($0, at + 1)
			n = split(path, part, ".")
			if (n == 2) { print "CONFIG_SECTIONS=\"$CONFIG_SECTIONS " part[2] "\" CONFIG_" part[2] "_TYPE=" value; next }
			gsub(/'\'' '\''/, " ", value)
			print "CONFIG_" part[2] "_" part[3] "=" value
		}')"
	[ -n "$CONFIG_SECTIONS" ]
}
config_get() { # VARIABLE SECTION OPTION [DEFAULT]
	eval "$1=\${CONFIG_$2_$3:-\$4}"
}
config_get_bool() { # VARIABLE SECTION OPTION [DEFAULT]
	config_get "$1" "$2" "$3" "$4"
	eval "case \$$1 in 1 | on | true | yes | enabled) $1=1 ;; 0 | off | false | no | disabled) $1=0 ;; *) $1=\$4 ;; esac"
}
config_foreach() { # FUNCTION [TYPE] [ARGUMENTS]
	_function=$1 _type=$2
	shift 2
	for _section in $CONFIG_SECTIONS; do
		eval "[ -z \"\$_type\" ] || [ \"\$CONFIG_${_section}_TYPE\" = \"\$_type\" ] || continue"
		$_function "$_section" "$@"
	done
}
config_list_foreach() { # SECTION OPTION FUNCTION [ARGUMENTS]
	config_get _list "$1" "$2"
	_function=$3
	shift 3
	for _item in $_list; do $_function "$_item" "$@"; done
}
uci_get_state() { uci -q get "$1.$2.$3"; }
find_config() { return 1; }

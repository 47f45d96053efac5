# Stand-in for procd's /lib/functions/procd.sh: an init script's instances and triggers as JSON for `ubus call
# service`. The functions have the real names; the JSON is built here, not by jshn.
PROCD_RELOAD_DELAY=1000

_json_text() {
	case $1 in
	*[\\\"]*) printf '"%s"' "$(printf '%s' "$1" | sed 's/[\\"]/\\&/g')" ;;
	*) printf '"%s"' "$1" ;;
	esac
}
_json_list() { # WORD...
	_list=
	for _word; do _list="$_list${_list:+,}$(_json_text "$_word")"; done
	printf '[%s]' "$_list"
}

_procd_open_service() { # NAME SCRIPT
	_procd_service=$1 _procd_script=$2 _procd_instances='' _procd_triggers='' _procd_number=0
}
_procd_close_service() {
	service_triggers
	ubus call service "${1:-set}" "{\"name\":\"$_procd_service\",\"script\":\"$_procd_script\",\"instances\":{$_procd_instances},\"triggers\":[$_procd_triggers]}"
}
_procd_kill() { # SERVICE [INSTANCE]
	ubus call service delete "{\"name\":\"$1\"${2:+,\"instance\":\"$2\"}}" 2>/dev/null
	return 0
}
_procd_running() { # SERVICE [INSTANCE]
	ubus call service list "{\"name\":\"$1\"}" | awk -v wanted="$2" '
		/^\t\t\t"/ { split($0, part, "\""); instance = part[2] }
		/"running": true/ && (wanted == "" || wanted == instance) { found = 1 }
		END { exit !found }'
}
_procd_status() { if _procd_running "$@"; then echo running; else echo inactive; fi; }
procd_kill() { _procd_kill "$@"; }
procd_running() { _procd_running "$@"; }
procd_lock() { return 0; }

procd_open_instance() {
	_procd_number=$((_procd_number + 1))
	_procd_instance=${1:-instance$_procd_number} _procd_command='' _procd_others=''
}
procd_set_param() { # NAME WORD...
	_type=$1
	shift
	case $_type in
	command)
		_procd_command=
		procd_append_param command "$@"
		;;
	respawn) _procd_others="$_procd_others,\"respawn\":$(_json_list "${1:-3600}" "${2:-5}" "${3:-5}")" ;;
	file | netdev | limits) _procd_others="$_procd_others,\"$_type\":$(_json_list "$@")" ;;
	env)
		_list=
		for _word; do _list="$_list${_list:+,}$(_json_text "${_word%%=*}"):$(_json_text "${_word#*=}")"; done
		_procd_others="$_procd_others,\"env\":{$_list}"
		;;
	stdout | stderr | no_new_privs) _procd_others="$_procd_others,\"$_type\":$([ "$1" = 0 ] && echo false || echo true)" ;;
	term_timeout) _procd_others="$_procd_others,\"$_type\":$1" ;;
	reload_signal) _procd_others="$_procd_others,\"$_type\":$(kill -l "$1")" ;;
	pidfile | user | group) _procd_others="$_procd_others,\"$_type\":$(_json_text "$1")" ;;
	esac
}
procd_append_param() { # NAME WORD...
	[ "$1" = command ] || return 0
	shift
	for _word; do _procd_command="$_procd_command${_procd_command:+,}$(_json_text "$_word")"; done
}
procd_close_instance() {
	_procd_instances="$_procd_instances${_procd_instances:+,}\"$_procd_instance\":{\"command\":[$_procd_command]$_procd_others}"
}

_procd_add_trigger() { _procd_triggers="$_procd_triggers${_procd_triggers:+,}$1"; }
procd_add_config_trigger() { # EVENT PACKAGE COMMAND...
	_event=$1 _package=$2
	shift 2
	_procd_add_trigger "[\"$_event\",[\"if\",[\"eq\",\"package\",\"$_package\"],$(_json_list run_script "$@")],$PROCD_RELOAD_DELAY]"
}
procd_add_interface_trigger() { # EVENT INTERFACE COMMAND...
	_event=$1 _interface=$2
	shift 2
	_procd_add_trigger "[\"$_event\",[\"if\",[\"eq\",\"interface\",\"$_interface\"],$(_json_list run_script "$@")],$PROCD_RELOAD_DELAY]"
}
procd_add_raw_trigger() { # EVENT DELAY_MS COMMAND...
	_event=$1 _delay=$2
	shift 2
	_procd_add_trigger "[\"$_event\",[$(_json_list run_script "$@")],$_delay]"
}
procd_add_reload_trigger() { for _file; do procd_add_config_trigger config.change "$_file" "/etc/init.d/$_procd_service" reload; done; }
procd_add_reload_interface_trigger() { procd_add_interface_trigger "interface.*" "$1" "/etc/init.d/$_procd_service" reload; }
procd_open_trigger() { return 0; }
procd_close_trigger() { return 0; }
procd_open_validate() { return 0; }
procd_close_validate() { return 0; }
procd_add_validation() { return 0; }

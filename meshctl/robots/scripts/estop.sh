# estop TOPIC TYPE PEER...: the message on standard input, on that topic, to each peer; prints one line of JSON per peer
# with the `outcome` that its daemon acknowledged. The robots act on it as on any emergency stop.
topic=$1 type=$2
shift 2
message=$(mktemp) || die no-space "cannot make a temporary file"
trap 'rm -f "$message"' EXIT
cat >"$message"
for peer in "$@"; do
	mesh pub "$topic" --file "$message" ${type:+--type "$type"} --to "$peer" --wait 10 --json 2>/dev/null &
done
wait
exit 0

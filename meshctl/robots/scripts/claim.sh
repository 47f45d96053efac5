# claim CURRENT DEAD: locks the robot for $owner until `release`, if it still runs the release CURRENT (`-`: any).
# DEAD is the owner of a claim whose process has died. Prints `claimed`, or `held OWNER SECONDS`.
current=$1 dead=$2
mkdir -p "$root" || die no-space "cannot make $root"
exec 9>"$root/.lock"
flock -n 9 || die busy "another command changes this robot right now"
claimed_by
case $claimer in
'' | "$owner" | "$dead") ;;
*) echo "held $claimer $claimed_s"; exit 0 ;;
esac
[ "$current" = - ] || [ "$current" = "$(release_of current)" ] ||
	die moved "another operator changed it a moment ago: it runs $(release_of current) now"
echo "$owner $uptime $boot" >"$root/.claim" || die no-space "cannot write to $root"
echo claimed

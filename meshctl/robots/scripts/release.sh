# release: gives the robot back, if $owner still holds it.
exec 9>"$root/.lock" || exit 0
flock -n 9 || exit 0
claimed_by
[ "$claimer" != "$owner" ] || rm -f "$root/.claim"
rmdir "$root" 2>/dev/null
exit 0

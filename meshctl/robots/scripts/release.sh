# release: removes the claim, if $owner still has it.
exec 9>"$root/.lock" || exit 0
flock -n 9 || exit 0
claimed_by
[ "$claimer" != "$owner" ] || rm -f "$root/.claim"
rmdir "$root" 2>/dev/null
exit 0

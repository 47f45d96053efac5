# install ID TREE: installs a release beside the others and checks it, without touching the running one. Its files come
# as a tar on stdin; its wheels are in wheels/ already. An interruption leaves only dot files behind.
id=$1 tree=$2
alone
new=$root/releases/.$id.new
new_tree=$root/trees/.$tree.new
trap 'rm -rf "$root"/releases/.*.new "$root"/trees/.*.new' EXIT
rm -rf "$root"/releases/.*.new "$root"/trees/.*.new
mkdir -p "$root/releases" "$root/trees" && mkdir -m 700 "$new" || die no-space "cannot write to $root"

if ! id "$account" >/dev/null 2>&1; then
	useradd --system --user-group --no-create-home --home-dir /var/lib/udp-mesh --shell /usr/sbin/nologin "$account" ||
		die account "cannot make the system user $account"
fi

tar -x --no-same-owner -f - -C "$new" || die no-space "cannot unpack the release"
(cd "$new" && sha256sum -c --quiet manifest) || die damaged "the release's files are not what was sent"
read -r python <"$new/python"

if [ ! -e "$root/trees/$tree/.sums" ] || ! (cd "$root/trees/$tree" && sha256sum -c --quiet .sums) >/dev/null 2>&1; then
	mkdir "$new_tree" || die no-space "cannot write to $root"
	(cd "$root/wheels" && sha256sum -c --quiet "$new/wheels") || die damaged "a wheel is not what was sent"
	while read -r _ wheel; do
		"$python" -m zipfile -e "$root/wheels/$wheel" "$new_tree" || die no-space "cannot unpack $wheel"
	done <"$new/wheels"
	# compiled now: the daemon's user may not write here, and a robot's first start should not be its slowest;
	# checked by hash, since a robot's clock may jump
	"$python" -m compileall -q --invalidation-mode checked-hash "$new_tree" >/dev/null ||
		die no-space "cannot compile the packages"
	(cd "$new_tree" && find . -type f ! -name .sums -exec sha256sum {} + >.sums) || die no-space "cannot write to $root"
	[ ! -e "$root/trees/$tree" ] || mv -T "$root/trees/$tree" "$root/trees/.$tree.old.new"
	mv -T "$new_tree" "$root/trees/$tree" || die no-space "cannot place the packages"
fi

chmod 755 "$new"
chown "$account:" "$new/etc"/*
words=$("$new/bin/udp-mesh" check "$new/etc/udp-mesh.toml" 2>&1) || die check "$words"
[ ! -e "$root/releases/$id" ] || mv -T "$root/releases/$id" "$root/releases/.$id.old.new"
sync -f "$root"
mv -T "$new" "$root/releases/$id" && sync -f "$root" || die no-space "cannot place the release"
echo "installed $id"

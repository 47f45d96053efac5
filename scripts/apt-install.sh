# Sourced by the setup scripts: the one way in which they install Debian packages. $program is the script's name.
die() {
    echo "$program: $*" >&2
    exit 1
}

# apt WORD...: non-interactive apt-get with timeouts, which starts no service on the developer's machine
apt() {
    timeout 600 $as_root env DEBIAN_FRONTEND=noninteractive NEEDRESTART_MODE=l RUNLEVEL=1 \
        apt-get -qq -o DPkg::Lock::Timeout=120 -o Acquire::Retries=3 -o Acquire::http::Timeout=30 "$@" </dev/null
}

# install_packages NAME...: updates apt's lists only if the packages cannot be installed without
install_packages() {
    command -v apt-get >/dev/null 2>&1 || die "expected Debian or Ubuntu, found no apt-get"
    as_root=
    if [ "$(id -u)" != 0 ]; then
        as_root=sudo
        command -v sudo >/dev/null 2>&1 || die "run as root: apt-get install --no-install-recommends $*"
    fi
    echo "$program: installing Debian packages: $*"
    apt install -y --no-install-recommends "$@" >/dev/null 2>&1 || {
        apt update || die "apt-get update failed; check that the package mirror is reachable"
        apt install -y --no-install-recommends "$@" >/dev/null || die "cannot install $*"
    }
}

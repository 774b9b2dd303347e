#!/usr/bin/env bash
# Run this checkout's HEAD on a bare Debian: a root file system that
# debootstrap makes, with make, git and CA certificates and nothing else.
#
#     tools/bare_debian.sh [--suite SUITE] [--base DIR] [--mirror URL] [--reuse | --remove] DIRECTORY [COMMAND...]
#
# DIRECTORY  where the root file system goes; must be empty or not exist yet
# COMMAND    shell commands, one an argument, run in order in a clone of HEAD
#            until one fails (default: "make demo" "make test"); the wall time
#            of each is printed
# --suite    Debian's release (default: bookworm)
# --base     keep a pristine copy of the bare system here, and begin with it
#            when it is there already
# --mirror   Debian's mirror (default: what apt uses on this machine)
# --reuse    begin with what an earlier run with --reuse left in DIRECTORY, if
#            there is any; its clone is brought to HEAD, its environment stays
# --remove   remove DIRECTORY at the end
#
# The machine's pip and proxy settings, CA certificates, name resolution and,
# if it runs the same release, apt sources are carried over, and nothing else of
# its environment.  For root only.  Mounts are made in a namespace of their own,
# so that none outlives the script.
set -euo pipefail

die() { printf 'bare_debian: %s\n' "$*" >&2; exit 1; }
usage() { sed -n '2,/^set /{/^set /d;s/^# \{0,1\}//;p}' "${BASH_SOURCE[0]}"; exit "$1"; }

suite=bookworm base='' mirror='' reuse=no remove=no
while [ $# -gt 0 ]; do
    case $1 in
        --suite) suite=$2; shift 2 ;;
        --base) base=$2; shift 2 ;;
        --mirror) mirror=$2; shift 2 ;;
        --reuse) reuse=yes; shift ;;
        --remove) remove=yes; shift ;;
        -h | --help) usage 0 ;;
        -*) die "no such option: $1 (see --help)" ;;
        *) break ;;
    esac
done
[ $# -ge 1 ] || usage 2 >&2
directory=$1; shift
[ $# -gt 0 ] || set -- "make demo" "make test"

[ "$reuse$remove" != yesyes ] || die "--reuse and --remove exclude each other"
[ "$(id -u)" = 0 ] || die "only root can make a root file system and enter it"
for tool in debootstrap git unshare chroot; do
    command -v "$tool" >/dev/null || die "$tool is not installed (apt-get install debootstrap git util-linux coreutils)"
done
checkout=$(git -C "$(dirname "${BASH_SOURCE[0]}")" rev-parse --show-toplevel)
git -C "$checkout" rev-parse --verify --quiet HEAD >/dev/null || die "there is no commit to test"
[ -z "$(git -C "$checkout" status --porcelain)" ] || echo "bare_debian: what is not committed is not tested" >&2
made=no
if [ "$reuse" = yes ] && [ -e "$directory/complete-$suite" ]; then
    made=yes
else
    [ -z "$(ls -A "$directory" 2>/dev/null)" ] || die "$directory is not empty, and holds no complete $suite; remove it"
fi
mkdir -p "$directory"
directory=$(realpath "$directory")

# Copy a file or directory of this machine to the same place in DIRECTORY.
carry() {
    local path
    for path in "$@"; do
        [ -e "$path" ] || continue
        mkdir -p "$directory$(dirname "$path")"
        rm -rf "${directory:?}$path"
        cp -rL "$path" "$directory$path"
    done
}

# Print a command's wall time after it; fail as it fails.
timed() {
    local name=$1 start=$SECONDS status=0
    shift
    "$@" || status=$?
    printf 'bare_debian: %s: %d s, exit status %d\n' "$name" $((SECONDS - start)) "$status"
    return "$status"
}

bootstrap() {
    if [ -z "$mirror" ]; then
        mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Label: Debian' \
            'Component: main' 2>/dev/null | head -n 1)
    fi
    mkdir -p "$1"
    debootstrap --variant=minbase --include=make,git,ca-certificates "$suite" "$1" ${mirror:+"$mirror"} >"$1.log" ||
        die "debootstrap failed; see $1.log and $1/debootstrap"
    rm "$1.log"
}

# The bare system.
if [ "$made" = yes ]; then
    echo "bare_debian: going on with what is in $directory" >&2
elif [ -z "$base" ]; then
    timed debootstrap bootstrap "$directory"
else
    if [ ! -e "$base/complete-$suite" ]; then
        [ -z "$(ls -A "$base" 2>/dev/null)" ] || die "$base is not empty, and holds no complete $suite"
        timed debootstrap bootstrap "$base"
        touch "$base/complete-$suite"
    fi
    cp -a --reflink=auto "$base/." "$directory"
    rm "$directory/complete-$suite"
fi
[ "$reuse" = no ] || touch "$directory/complete-$suite"

# What of this machine it takes to reach the network.
carry /etc/resolv.conf /etc/hosts /etc/ssl/certs/ca-certificates.crt /etc/pip.conf
[ -z "${PIP_CERT:-}" ] || carry "$PIP_CERT"
if [ "$(. /etc/os-release && echo "${VERSION_CODENAME:-}")" = "$suite" ]; then
    rm -f "$directory/etc/apt/sources.list"
    carry /etc/apt/sources.list /etc/apt/sources.list.d/debian.sources
fi
for file in /etc/apt/apt.conf /etc/apt/apt.conf.d/*; do
    if [ -f "$file" ] && grep -qi 'Acquire::' "$file"; then carry "$file"; fi
done

clone=$directory/root/checkout
[ -d "$clone" ] || git clone --quiet --depth 1 "file://$checkout" "$clone"
git -C "$clone" fetch --quiet --depth 1 "file://$checkout" HEAD
git -C "$clone" reset --quiet --hard FETCH_HEAD

environment=(HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin TERM="${TERM:-dumb}")
while IFS= read -r name; do
    environment+=("$name=${!name}")
done < <(compgen -e | grep -E '^PIP_|^(https?|ftp|no|all)_proxy$|^(HTTPS?|FTP|NO|ALL)_PROXY$' || true)

inside() {
    # shellcheck disable=SC2016
    unshare --mount --pid --fork --kill-child bash -euc '
        root=$1; shift
        mount -t proc proc "$root/proc"
        mount --rbind /dev "$root/dev"
        mount -t sysfs -o ro sysfs "$root/sys"
        exec chroot "$root" "$@"
    ' bash "$directory" /usr/bin/env -i "${environment[@]}" /bin/sh -c "cd /root/checkout && $1"
}

status=0
for command in "$@"; do
    timed "$command" inside "$command" || { status=$?; break; }
done
if [ "$remove" = yes ]; then
    rm -rf --one-file-system "$directory"
fi
exit "$status"

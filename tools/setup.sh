#!/usr/bin/env bash
# Make sure that Debian's packages and the virtual environment are there.
#
#     tools/setup.sh [--wheel] [EXTRA...]
#
# On Debian 12 and 13 dolfinx is Debian's (0.5 and 0.9), and the environment is
# .venv.  With --wheel it is the wheel of PyPI (0.11, with an MPI of its own), the
# environment is .venv-wheel, and Debian gives Python >= 3.12 and a compiler.
#
# Each EXTRA is an optional dependency group of pyproject.toml; `dev` is always
# installed.  Nothing is done, and no network is used, when nothing is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PYTHONNOUSERSITE=1

packages=(
    ca-certificates
    g++
    gcc
    python3-dev
    python3-venv
)
if [ "${1:-}" = --wheel ]; then
    shift
    environment=.venv-wheel extras=dev,viz,wheel pinned=()
    options=()
    packages+=(libgl1 libglu1-mesa libxcursor1 libxft2 libxinerama1) # for PyPI's gmsh
else
    environment=.venv extras=dev,debian
    options=(--system-site-packages)
    packages+=(
        libopenblas0-serial
        openmpi-bin
        python3-dolfinx
        python3-gmsh
        python3-h5py
        python3-matplotlib
        python3-meshio
    )
    # The distributions that Debian provides and pip must leave as they are.
    pinned=(fenics-basix fenics-dolfinx fenics-ffcx fenics-ufl matplotlib meshio mpi4py numpy petsc4py scipy)
fi

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$@"; exit 1; }

# Run a command up to three times, for the network's sake.
retry() {
    local attempt
    for attempt in 1 2 3; do
        "$@" && return 0
        [ "$attempt" = 3 ] && return 1
        say "failed, once more in $((5 * attempt)) s: $*"
        sleep $((5 * attempt))
    done
}

debian_packages() {
    command -v dpkg-query >/dev/null ||
        die "this is not Debian 12 or 13; provide what these packages provide: ${packages[*]}"

    local installed missing=() name
    installed=" $(dpkg-query -W -f '${db:Status-Status}:${Package} ' "${packages[@]}" 2>/dev/null || true)"
    for name in "${packages[@]}"; do
        [[ $installed == *" installed:$name "* ]] || missing+=("$name")
    done
    [ ${#missing[@]} -gt 0 ] || return 0

    local root=()
    if [ "$(id -u)" != 0 ]; then
        command -v sudo >/dev/null ||
            die "neither root nor sudo; have these packages installed, and try again: ${missing[*]}"
        root=(sudo)
    fi
    say "installing Debian's packages (up to 2.6 GB when none is there yet): ${missing[*]}"
    apt=("${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Acquire::Retries=3)
    retry apt_install "${missing[@]}" ||
        die "apt-get failed; have these packages installed, and try again: ${missing[*]}"
}

# An update that fails for want of network is only a warning, hence both at
# each attempt.  Their output is thousands of lines; errors still show.
apt_install() {
    "${apt[@]}" update >/dev/null && "${apt[@]}" install -y --no-install-recommends "$@" >/dev/null
}

# Write a pip constraint for each distribution that Debian provides.
constraints() {
    /usr/bin/python3 - "${pinned[@]}" <<'PYTHON'
import importlib.metadata
import sys

for name in sys.argv[1:]:
    try:
        print(f"{name}=={importlib.metadata.version(name)}")
    except importlib.metadata.PackageNotFoundError:
        sys.exit(f"setup: /usr/bin/python3 knows no {name}, which Debian's packages should have provided")
PYTHON
}

# A stamp for each set of extras holds the path of the checkout it was made
# for: a virtual environment cannot be moved.
is_current() {
    [ -x "$environment/bin/python" ] && [ -f "$1" ] && [ ! pyproject.toml -nt "$1" ] && [ "$(<"$1")" = "$PWD" ]
}

virtual_environment() {
    local basic="$environment/stamp-$extras" extra
    for extra in "$@"; do
        [[ ,$extras, == *",$extra,"* ]] || extras+=",$extra"
    done
    local stamp="$environment/stamp-$extras"
    ! is_current "$stamp" || return 0

    /usr/bin/python3 -c 'import sys; sys.exit(sys.version_info < (3, 12))' || [ "$environment" != .venv-wheel ] ||
        die "the wheel of dolfinx needs Python >= 3.12, and /usr/bin/python3 is older; \`make test-wheel\` uses Debian 13's"

    # Another path, another Python, or an attempt that was cut short: begin anew.
    if [ "$(cat "$environment/checkout" 2>/dev/null)" != "$PWD" ] || ! "$environment/bin/python" -c '' 2>/dev/null; then
        say "making $environment"
        rm -rf "$environment"
        /usr/bin/python3 -m venv "${options[@]}" "$environment"
        pwd >"$environment/checkout"
    fi

    say "installing this project, with [$extras], into $environment"
    constraints >"$environment/constraints.txt"
    local binary=:all:
    [ ${#pinned[@]} = 0 ] || binary=$(IFS=,; echo "${pinned[*]}")
    retry "$environment/bin/python" -m pip install --quiet --disable-pip-version-check \
        --only-binary "$binary" --constraint "$environment/constraints.txt" --editable ".[$extras]" ||
        die "pip could not install this project's [$extras]"
    pwd | tee "$basic" >"$stamp"
}

debian_packages
virtual_environment "$@"

#!/bin/sh
# What the Makefile needs from the machine.
#   environment.sh system        find a Python; install, or name, missing Debian packages
#   environment.sh create DIR    make the virtual environment DIR unless a working one is there
# PYTHON in the environment overrides the search.
set -eu

here=$(dirname "$0")

fits() { "$1" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' >/dev/null 2>&1; }
has_venv() { "$1" -c 'import venv, ensurepip, ctypes' >/dev/null 2>&1; }

# The first fitting interpreter that can make an environment; else the first fitting one.
find_python() {
    spare=
    for candidate in ${PYTHON:-python3.11 python3.12 python3}; do
        fits "$candidate" || continue
        has_venv "$candidate" && { echo "$candidate"; return; }
        spare=${spare:-$candidate}
    done
    echo "$spare"
}

as_root() {
    if [ "$(id -u)" = 0 ]; then echo "env"; elif sudo -n true 2>/dev/null; then echo "sudo -n env"; fi
}

# install PACKAGE...: with apt-get where we may, else one line that says what to type.
install() {
    root=$(as_root)
    if ! command -v apt-get >/dev/null 2>&1; then
        echo "spherecal: install your system's packages for these Debian ones: $*, then run make again." >&2
        exit 1
    elif [ -z "$root" ]; then
        echo "spherecal: missing system packages. Run: sudo apt-get install --no-install-recommends $*" >&2
        exit 1
    fi
    echo "Installing system packages: $*"
    log=$(mktemp)
    if $root apt-get update -qq >"$log" 2>&1 &&
        $root DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends "$@" >>"$log" 2>&1 </dev/null; then
        rm -f "$log"
    else
        cat "$log" >&2
        rm -f "$log"
        echo "spherecal: apt-get failed (above). Mend it, or run: apt-get install --no-install-recommends $*" >&2
        exit 1
    fi
}

no_python() {
    if [ -n "${PYTHON:-}" ]; then
        echo "spherecal: PYTHON=$PYTHON is no Python 3.11 or 3.12." >&2
        exit 1
    fi
    for version in 3.12 3.11; do
        if apt-cache show "python$version-venv" >/dev/null 2>&1; then
            echo "spherecal: needs Python 3.11 or 3.12. Run: sudo apt-get install python$version python$version-venv" >&2
            exit 1
        fi
    done
    echo "spherecal: needs Python 3.11 or 3.12 (Debian 12: apt-get install python3 python3-venv; Ubuntu 22.04: python3.11 python3.11-venv;" \
        "Ubuntu 24.04: python3 python3-venv). Where the system packages neither, build one with pyenv or uv and run: make PYTHON=/path/to/python3.12" >&2
    exit 1
}

python=$(find_python)
[ -n "$python" ] || no_python

case $1 in
system)
    missing=
    has_venv "$python" || missing="python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    # Only Linux splits these off; ctypes is in every Python that has_venv accepts or Debian's stdlib package brings.
    [ "$(uname -s)" = Linux ] && missing="$missing $("$python" "$here/system_libraries.py")"
    # shellcheck disable=SC2086  # a list of package names
    set -- $missing
    [ $# = 0 ] || install "$@"
    ;;
create)
    venv=$2
    if ! fits "$venv/bin/python" || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        "$python" -m venv --clear "$venv"
    fi
    ;;
*)
    echo "usage: $0 system | create DIR" >&2
    exit 2
    ;;
esac

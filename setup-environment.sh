# Sourced by ./steadypose and ./test, with $root set to the checkout. `install EXTRA...` makes .venv match uv.lock with
# these extras. It is quick if there is nothing to do, and keeps what is installed already.
UV_VERSION=0.13.8

# Finds a Python to install with: if ROS is sourced ROS's own, because rclpy runs on no other; else 3.11 first, on which
# most figures were measured. It prints the real path, because a name on PATH may be a stub that cannot run, or a shim,
# and uv would recreate the environment if the path changed.
find_python() {
    for name in ${ROS_DISTRO:+python3} python3.11 python3.12 python3.13 python3.10 python3; do
        if "$name" -I -c 'import sys
if not (3, 10) <= sys.version_info[:2] <= (3, 13):
    sys.exit(1)
print(sys.executable)' 2>/dev/null; then
            return
        fi
    done
    echo "steadypose needs Python 3.10 to 3.13, and found none. On Debian or Ubuntu: sudo apt install python3-venv" >&2
    return 1
}

install_uv() {
    if [ -x "$root/.uv/bin/uv" ]; then
        return
    fi
    # by the Python's own pip if it can do that, because installing pip into the new folder takes five seconds
    if "$1" -I -m pip --python "$1" --version >/dev/null 2>&1; then
        "$1" -I -m venv --without-pip "$root/.uv"
        "$1" -I -m pip --python "$root/.uv/bin/python" install --quiet --disable-pip-version-check "uv==$UV_VERSION"
    else
        "$1" -I -m venv "$root/.uv" || {
            echo "Python's venv module is missing. On Debian or Ubuntu: sudo apt install python3-venv" >&2
            exit 1
        }
        "$root/.uv/bin/python" -I -m pip install --quiet --disable-pip-version-check "uv==$UV_VERSION"
    fi
}

install() {
    stamp="$root/.venv/.installed-$(echo "$@" | tr ' ' '-')"
    if [ -e "$stamp" ] && [ ! "$root/uv.lock" -nt "$stamp" ] && [ ! "$root/pyproject.toml" -nt "$stamp" ]; then
        return
    fi
    python=$(find_python)
    echo "Installing steadypose[$(echo "$@" | tr ' ' ',')] into $root/.venv, once" >&2
    install_uv "$python"
    extras=
    for extra in "$@"; do
        extras="$extras --extra $extra"
    done
    # shellcheck disable=SC2086  (split into words on purpose)
    (unset VIRTUAL_ENV UV_PROJECT_ENVIRONMENT &&
        "$root/.uv/bin/uv" sync --project "$root" --frozen --inexact --python "$python" $extras)
    # compiles the loops now, so that the first stream does not wait for it
    "$root/.venv/bin/python" -I -m steadypose.nodes.graph.loops
    touch "$stamp"
}

# Installs extras by name, in addition to what is installed.
add() {
    known=$(sed -n '/^\[project.optional-dependencies\]/,/^\[/s/^\([a-z0-9-]*\) = \[.*/\1/p' "$root/pyproject.toml")
    if [ $# -eq 0 ]; then
        echo "steadypose add: expected an extra, one of $(echo $known)" >&2
        exit 2
    fi
    for extra in "$@"; do
        if ! echo "$known" | grep -qx -- "$extra"; then
            echo "steadypose add: no extra '$extra'; there are $(echo $known)" >&2
            exit 2
        fi
        if [ "$extra" = train ] && [ ! -d "$root"/.venv/lib/python*/site-packages/torch ]; then
            echo "The extra train brings torch with its CUDA libraries: about 5 GB are downloaded; Ctrl-C stops it." >&2
        fi
    done
    install "$@"
}

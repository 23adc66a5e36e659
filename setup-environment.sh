# Sourced by ./steadypose and ./test: makes .venv match uv.lock. Quick when there is nothing to do.
UV_VERSION=0.13.8

stamp=.venv/.installed
if [ ! -e "$stamp" ] || [ uv.lock -nt "$stamp" ] || [ pyproject.toml -nt "$stamp" ]; then
    python=$(command -v python3.11 || command -v python3 || true)
    if [ -z "$python" ] || ! "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then
        echo "steadypose needs Python 3.11; found: ${python:-none}. On Debian 12: sudo apt install python3 python3-venv" >&2
        exit 1
    fi
    echo "Installing steadypose into .venv (about 6 GB, most of it torch; once)" >&2
    if [ ! -x .uv/bin/uv ]; then
        "$python" -m venv .uv || {
            echo "Python's venv module is missing. On Debian: sudo apt install python3-venv" >&2
            exit 1
        }
        .uv/bin/python -m pip install --quiet --disable-pip-version-check "uv==$UV_VERSION"
    fi
    .uv/bin/uv sync --frozen --inexact --compile-bytecode --extra view --python "$python"
    # numba compiles its loops once; else the first stream would wait for it
    .venv/bin/python -c "import steadypose.prior.camera.depth_lifting, steadypose.prior.world.root_filter; from steadypose.prior.clean.pipeline import load_loops; load_loops()"
    touch "$stamp"
fi

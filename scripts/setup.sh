#!/bin/sh
# Create .venv with the versions of requirements.lock, and install OpenGL if it is missing. `make setup` runs this from the root.
set -eu

as_root_with_apt() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; }

install_debian() { # packages...
    apt-get update -q >/dev/null && DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "$@" >/dev/null
}

python=${PYTHON:-}
if [ -z "$python" ]; then
    for candidate in python3.11 python3.12 python3.13 python3; do
        if command -v "$candidate" >/dev/null 2>&1 &&
            "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))'; then
            python=$candidate
            break
        fi
    done
fi
if [ -z "$python" ]; then
    echo "setup: Python 3.11, 3.12 or 3.13 was not found: install it, or run make PYTHON=/path/to/python3.11" >&2
    exit 1
fi

if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    if as_root_with_apt; then
        install_debian python3-venv
    else
        echo "setup: $python cannot create virtual environments: run 'sudo apt-get install -y python3-venv', then make again" >&2
        exit 1
    fi
fi
[ -x .venv/bin/python ] || "$python" -m venv .venv
.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable '.[dev]'

if ! .venv/bin/python -m tactip_twin.tactip_model.pyrender_renderer >/dev/null 2>&1; then
    packages=$(.venv/bin/python -c 'from tactip_twin.tactip_model.opengl import DEBIAN_PACKAGES as p; print(*p)')
    if as_root_with_apt; then
        echo "setup: installing OpenGL: $packages"
        # shellcheck disable=SC2086 # the list must be split
        install_debian $packages
        .venv/bin/python -m tactip_twin.tactip_model.pyrender_renderer
    else
        .venv/bin/python -m tactip_twin.tactip_model.pyrender_renderer >&2 || true
        echo "setup: OpenGL is missing: run 'sudo apt-get install -y $packages', then make again" >&2
        exit 1
    fi
fi

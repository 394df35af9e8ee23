#!/bin/sh
# Make a virtual environment and install the package into it: tools/install.sh PYTHON VENV [EXTRAS] [CONSTRAINTS]
# EXTRAS in brackets, such as '[dev]'; CONSTRAINTS is a file of pinned versions.
set -eu
python=$1 venv=$2 extras=${3:-} constraints=${4:-}
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
    || { echo "install: $python is missing or older than Python 3.11; name one with: make PYTHON=python3.12 ..." >&2; exit 1; }
if [ ! -x "$venv/bin/python" ]; then
    echo "install: making $venv"
    "$python" -m venv "$venv" 2>/dev/null || {
        # Debian and Ubuntu ship Python without its venv module.
        if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
            echo "install: the venv module is missing; installing python3-venv"
            apt-get update -qq >/dev/null 2>&1 && apt-get install -y -qq python3-venv >/dev/null 2>&1
            rm -rf "$venv" && "$python" -m venv "$venv"
        else
            echo "install: Python's venv module is missing; install it, e.g. 'sudo apt-get install python3-venv'" >&2; exit 1
        fi
    }
fi
echo "install: seasonscapes$extras into $venv"
"$venv/bin/python" -m pip install -q --disable-pip-version-check ${constraints:+-c "$constraints"} -e ".$extras"

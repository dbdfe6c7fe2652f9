#!/usr/bin/env bash
# What the newest numba, pre-releases included, makes of dynsim: the pieces of numba that dynsim replaces while it
# compiles are compared with those it was checked with, and a pendulum is run. Not part of what must be green.
set -euo pipefail
cd "$(dirname "$0")/.."
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

python3 -m venv "$scratch/env"
"$scratch/env/bin/pip" install --quiet --disable-pip-version-check -c .ci/constraints.txt .
"$scratch/env/bin/pip" install --quiet --disable-pip-version-check --upgrade --pre numba 2> /dev/null
"$scratch/env/bin/python" -c "import numba, numpy; print('next numba:', numba.__version__, 'with numpy', numpy.__version__)"
cd "$scratch"
XDG_CACHE_HOME="$scratch/cache" "$scratch/env/bin/dynsim" run single_pendulum --quiet --no-figures && echo "next numba: ok"

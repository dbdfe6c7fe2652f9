#!/usr/bin/env bash
# The wheel, as somebody installs it: built, checked, and in a clean environment and an empty folder it compares the
# elbows; on every supported Python that is installed, on the oldest one with the oldest libraries that pyproject.toml
# allows, and on the newest one with the newest libraries, without constraints. Versions that are not installed are
# listed at the end. Arguments: versions to try instead, such as 3.12, oldest, newest.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

python3 -m venv "$scratch/tools"
"$scratch/tools/bin/pip" install --quiet --disable-pip-version-check build twine uv
"$scratch/tools/bin/python" -m build --outdir "$scratch/dist" . > "$scratch/build.log" 2>&1 || { cat "$scratch/build.log"; exit 1; }
"$scratch/tools/bin/twine" check --strict "$scratch"/dist/*
wheel=$(echo "$scratch"/dist/*.whl)

python_of() {  # the interpreter of a version, of the system or of pyenv; no output if it is not installed
  command -v "/usr/bin/python$1" || { ls -d "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python 2> /dev/null || true; } | sort -V | tail -1
}

# The classifiers name the supported versions; pyproject.toml also allows 3.14 and later ones, which are tried if installed.
supported=$(grep -o 'Python :: 3\.[0-9]*' pyproject.toml | grep -o '3\..*'; echo 3.14)
oldest=$(echo "$supported" | sort -V | head -1)
found=() missing=()
for version in $({ echo "$supported"; for minor in {11..30}; do [ -z "$(python_of "3.$minor")" ] || echo "3.$minor"; done; } | sort -Vu); do
  if [ -n "$(python_of "$version")" ]; then found+=("$version"); else missing+=("$version"); fi
done

for version in ${@:-${found[@]} oldest newest}; do
  constraints=(-c "$root/.ci/constraints.txt")
  number=${version/oldest/$oldest}
  python=$(python_of "${number/newest/${found[-1]}}")
  if [ -z "$python" ]; then
    missing+=("$version")
    continue
  fi
  if [ "$version" = oldest ]; then
    "$scratch/tools/bin/uv" pip compile --quiet --resolution lowest-direct --python-version "$oldest" pyproject.toml > "$scratch/oldest.txt"
    constraints=(-c "$scratch/oldest.txt")
  elif [ "$version" = newest ]; then
    constraints=(--upgrade numpy scipy)
  fi
  "$python" -m venv "$scratch/$version"
  "$scratch/$version/bin/pip" install --quiet --disable-pip-version-check "${constraints[@]}" "$wheel"
  mkdir "$scratch/empty-$version"
  (
    cd "$scratch/empty-$version"
    export XDG_CACHE_HOME="$scratch/cache-$version"
    unset PYTHONPATH
    "../$version/bin/dynsim" compare elbow_comparison --quiet --no-figures
    "../$version/bin/python" - << 'END'
import importlib.metadata
import json
import pathlib
import sys

import dynsim

record = dynsim.Record.load("results/elbow_comparison/two_elbows/record.h5")
assert len(record.provenance["commit"]) == 40, record.provenance["commit"]
energy = record.summary["electrical_energy_J"]
assert abs(energy - 219.7) < 0.1, energy
size = sum(f.stat().st_size for f in pathlib.Path(sys.prefix, "lib").rglob("*") if f.is_file())
versions = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "numba", "matplotlib", "pydantic")}
print(f"wheel: Python {sys.version.split()[0]}, {energy:.1f} J, installed {size / 1e6:.0f} MB, {json.dumps(versions)}")
END
  )
  rm -rf "$scratch/$version" "$scratch/cache-$version"
done
if [ ${#missing[@]} != 0 ]; then
  echo "wheel: NOT tested, because not installed: Python $(printf '%s\n' "${missing[@]}" | sort -Vu | paste -sd " ")"
fi

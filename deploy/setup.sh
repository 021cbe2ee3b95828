#!/usr/bin/env bash
# Creates the virtual environment: locked packages, the `dg4d` command, a new database for Prefect, and the two system
# libraries that pymeshlab needs. CUDA=1 installs torch for CUDA, gsplat and the diffusion models instead of torch's CPU
# build.
set -euo pipefail
: "${PYTHON:=python3}" "${VENV:=.venv}" "${TORCH_INDEX=https://download.pytorch.org/whl/cpu}" "${CUDA:=0}"

"$PYTHON" - <<'PY' || exit 1
import sys
if not (3, 11) <= sys.version_info[:2] < (3, 13):
    sys.exit(f"dg4d needs Python 3.11 or 3.12; this is {sys.version.split()[0]}. Name another: make setup PYTHON=python3.11")
PY
# an interrupted or failed venv leaves an interpreter without pip
"$VENV/bin/python" -m pip --version >/dev/null 2>&1 || "$PYTHON" -m venv "$VENV" || {
    echo "Could not make a virtual environment. On Debian: apt-get install python3-venv" >&2; exit 1; }
export VENV TORCH_INDEX
if [ "$CUDA" = 1 ]; then
    # pip takes torch 2.x+cpu for torch 2.x and would keep it
    if "$VENV/bin/python" -c 'import importlib.metadata as m, sys; sys.exit(not m.version("torch").endswith("+cpu"))' 2>/dev/null
    then
        "$VENV/bin/python" -m pip --disable-pip-version-check uninstall --quiet --yes torch
    fi
    bash deploy/install.sh cuda steps flows dev
else
    bash deploy/install.sh torch steps flows dev
fi
"$VENV/bin/python" -m pip --disable-pip-version-check install --quiet --no-deps --no-build-isolation --editable .
"$VENV/bin/python" -m flows.serving.database_template

# pymeshlab imports without these but then lacks its filters.
filters() { "$VENV/bin/python" -c 'import pymeshlab; print(len(pymeshlab.filter_list()))' 2>/dev/null || echo 0; }
if [ "$(filters)" -lt 281 ]; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        apt-get update -qq && apt-get install -y -qq --no-install-recommends libgl1 libopengl0 >/dev/null
    fi
    [ "$(filters)" -ge 281 ] || {
        echo "pymeshlab cannot load its filters: the system libraries libGL.so.1 and libOpenGL.so.0 are missing." >&2
        echo "On Debian or Ubuntu: sudo apt-get install libgl1 libopengl0" >&2; exit 1; }
fi

if [ "$CUDA" = 1 ]; then
    lacks=$("$VENV/bin/python" -c 'from dg4d_lib.rasterizer.backends import gsplat_unavailable_reason; print(gsplat_unavailable_reason())')
    [ -z "$lacks" ] || echo "The GPU cannot be used yet: $lacks" >&2
    PATH="$PWD/$VENV/bin:$VENV/bin:$PATH" "$VENV/bin/python" deploy/gsplat_kernels.py || {
        echo "Without them gsplat compiles when it first draws, which needs nvcc of CUDA 13.0 on the PATH." >&2; }
fi

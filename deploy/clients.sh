#!/usr/bin/env bash
# Readers of other people for the tests: npm packages, Chromium, and the compressor of meshes. What cannot be had is
# named, and the tests that need it are skipped; nothing else depends on it.
set -uo pipefail
cd "$(dirname "$0")/.."
: "${VENV:=.venv}"
missing() { echo "tests of other people's readers will be skipped: $1" >&2; }

if command -v npm >/dev/null; then
    for folder in tests/clients dg4d_lib/assets/viewer; do
        lock="$folder/package-lock.json"
        [ -f "$lock" ] || continue
        cmp -s "$lock" "$folder/node_modules/.installed" && continue
        if npm ci --ignore-scripts --prefix "$folder" --loglevel error >/dev/null; then
            cp "$lock" "$folder/node_modules/.installed"
        else
            missing "npm could not install $folder"
        fi
    done
else
    missing "npm is not here (Debian: apt-get install npm)"
fi

if ! command -v chromium >/dev/null; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium >/dev/null
    fi
    command -v chromium >/dev/null || missing "chromium is not here (Debian: apt-get install chromium)"
fi

"$VENV/bin/python" -c 'import meshoptimizer' 2>/dev/null ||
    VENV="$VENV" bash deploy/install.sh meshopt ||
    missing "meshoptimizer could not be compiled (Debian: apt-get install g++)"

#!/usr/bin/env bash
# Installs locks of deploy/locks into a virtual environment. A file whose SHA-256 its lock does not name is refused,
# wherever it came from.
#
#   deploy/install.sh LOCK ...        for example: steps torch
#
# $VENV is the environment (.venv). The CPU build of torch is not on PyPI: where the configured package sources lack it,
# it comes from $TORCH_INDEX, which is asked for nothing else.
set -euo pipefail
: "${VENV:=.venv}" "${TORCH_INDEX=https://download.pytorch.org/whl/cpu}"
locks="$(dirname "$0")/locks"

# No dependencies: the locks are complete. Wheels only: installing runs no code of a package.
locked() {
    "$VENV/bin/python" -m pip --disable-pip-version-check install --quiet --no-deps --require-hashes "$@"
}

torch() {
    local said wheel=(--only-binary :all: -r "$locks/torch.txt")
    said=$(locked "${wheel[@]}" 2>&1) && return
    if [ -z "$TORCH_INDEX" ] || ! locked "${wheel[@]}" --index-url "$TORCH_INDEX"; then
        echo "torch could not be installed. The configured package sources said:" >&2
        echo "$said" >&2
        return 1
    fi
}

[ $# -gt 0 ] || { sed -n '2,8s/^# \{0,1\}//p' "$0"; exit 2; }
wheels=()
for lock in "$@"; do
    [ -f "$locks/$lock.txt" ] || { echo "There is no lock $lock: $(cd "$locks" && echo *.txt)" >&2; exit 2; }
    case "$lock" in
        torch) torch ;;
        # a source package, compiled with the locked setuptools
        meshopt) locked --no-build-isolation -r "$locks/meshopt.txt" ;;
        *) wheels+=(-r "$locks/$lock.txt") ;;
    esac
done
[ ${#wheels[@]} -eq 0 ] || locked --only-binary :all: "${wheels[@]}"

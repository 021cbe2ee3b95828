#!/usr/bin/env bash
# Builds the images of deploy/images with docker, else with podman.
#
#   deploy/containers.sh build [NAME ...] [-- ARGUMENT ...]   builds images; default: cpu flows
#       cpu, cuda      dg4d/cpu, dg4d/cuda: the steps
#       flows          dg4d/flows: server, workers and runs; needs dg4d/cpu
#       flows-cuda     dg4d/flows:cuda: the same for GPUs; needs dg4d/cuda
#   deploy/containers.sh base                                 dg4d/python, a base image of Debian's own packages, where
#                                                             no registry can be reached; then build with
#                                                             -- --build-arg PYTHON=dg4d/python
#
# What follows `--` goes to the engine, for example --secret id=pip,src=pip.conf for a package index of your own.
# $DG4D_ENGINE chooses the engine.
set -euo pipefail
cd "$(dirname "$0")/.."
base=dg4d/python

engine() {
    if [ -n "${DG4D_ENGINE:-}" ]; then echo "$DG4D_ENGINE"; return; fi
    for name in docker podman; do
        if "$name" ps --quiet >/dev/null 2>&1; then echo "$name"; return; fi
    done
    echo "Neither docker nor podman runs here. On Debian: apt-get install podman runc" >&2
    exit 69
}

# Without a daemon of its own, podman builds in a plain chroot, which also works inside of other containers.
builder() {
    case "$(basename "$1")" in
        podman) echo "$1 build --isolation chroot --format docker --ignorefile .dockerignore" ;;
        *) echo "$1 build" ;;
    esac
}

build() {
    local names=() target=() program
    while [ $# -gt 0 ] && [ "$1" != -- ]; do names+=("$1"); shift; done
    [ $# -gt 0 ] && shift
    program=$(engine)
    [ ${#names[@]} -gt 0 ] || names=(cpu flows)
    for name in "${names[@]}"; do
        case "$name" in
            cpu | cuda | flows) target=(--file "deploy/images/$name.Dockerfile" --tag "dg4d/$name") ;;
            flows-cuda)
                target=(--file deploy/images/flows.Dockerfile --tag dg4d/flows:cuda --build-arg STEPS=dg4d/cuda) ;;
            *) echo "There is no image $name; use cpu, cuda, flows or flows-cuda." >&2; exit 2 ;;
        esac
        $(builder "$program") "${target[@]}" "$@" .
    done
}

base() {
    local program
    program=$(engine)
    command -v debootstrap >/dev/null || { echo "On Debian: apt-get install debootstrap (as root)" >&2; exit 69; }
    folder=$(mktemp -d)  # not local: the trap runs outside of this function
    trap 'rm -rf "$folder"' EXIT
    debootstrap --variant=minbase --include=python3,python3-venv,python3-dev,ca-certificates bookworm "$folder/root"
    ln -s python3 "$folder/root/usr/bin/python"
    tar -C "$folder/root" -c . | "$program" import --change 'CMD ["python"]' - "$base"
}

case "${1:-}" in
    build) shift; build "$@" ;;
    base) base ;;
    *) sed -n '2,13s/^# \{0,1\}//p' "$0"; exit 2 ;;
esac

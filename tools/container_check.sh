#!/usr/bin/env bash
# Runs the package as in a container: read-only installation, no home, 64 MB of /dev/shm. Linux, as root.
#
#     bash tools/container_check.sh [PYTHON]        # an interpreter with the package's dependencies (default: python3)
#
# Prints one line for each check, and fails if any of them fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="$(command -v "${1:-python3}")"
if [[ -z "${INSIDE_CONTAINER_CHECK:-}" ]]; then
    unshare --mount true 2>/dev/null || { echo "unshare --mount is not permitted here: root on Linux is needed" >&2; exit 1; }
    INSIDE_CONTAINER_CHECK=1 exec unshare --mount bash "${BASH_SOURCE[0]}" "${python}"
fi

work="$(mktemp -d)"
trap 'umount "${work}/package" /dev/shm; rm -rf "${work}"' EXIT
mkdir "${work}/package"
cp -r src/cobevglue "${work}/source"
find "${work}/source" -name __pycache__ -prune -exec rm -rf {} +
mkdir "${work}/site" && mv "${work}/source" "${work}/site/cobevglue"
mount --bind "${work}/site" "${work}/package"
mount -o remount,bind,ro "${work}/package"
mount -t tmpfs -o size=64m tmpfs /dev/shm

boxes='{"boxes": [{"x": 5, "y": 2, "l": 4, "w": 2, "yaw": 0}, {"x": 12, "y": -4, "l": 5, "w": 2, "yaw": 1},
 {"x": -8, "y": 6, "l": 4, "w": 2, "yaw": 2}, {"x": 20, "y": 9, "l": 9, "w": 3, "yaw": 0.5}]}'
echo "${boxes}" >"${work}/list.json"

failed=0
check() { # what, expected text in the output, command ...
    local what="$1" expected="$2" output code=0
    shift 2
    output="$(cd "${work}" && env -u PYTHONPATH -u NUMBA_CACHE_DIR HOME=/proc/none XDG_CACHE_HOME=/proc/none \
        PYTHONPATH="${work}/package" PYTHONDONTWRITEBYTECODE=1 "${python}" "$@" 2>&1)" || code=$?
    if [[ ${code} -eq 0 && "${output}" == *"${expected}"* && "${output}" != *Traceback* ]]; then
        echo "passed: ${what}"
    else
        printf 'FAILED: %s (exit %s)\n%s\n' "${what}" "${code}" "${output}" | tail -n 20
        failed=1
    fi
}

check "the package is the read-only one" "${work}/package" -c "import cobevglue; print(cobevglue.__file__)"
check "align works, and names NUMBA_CACHE_DIR" "NUMBA_CACHE_DIR" -m cobevglue align list.json list.json
check "training with two workers" "" -m cobevglue train detector --config tiny --out run --set data.workers=2 \
    --set model=compact
exit "${failed}"

#!/bin/sh
# Prints the path of a Python of at least 3.11. PYTHON=/path/to/python chooses one.
# (The python3-minimal of some images lacks half the standard library and does not count.)
# As root on Debian or Ubuntu it installs one where there is none; otherwise it names the command.
set -u

find_python() {
    for candidate in "${PYTHON:-}" python3 python3.11 python3.12 python3.13 python3.14 /usr/bin/python3; do
        [ -n "$candidate" ] || continue
        "$candidate" -c 'import json, sys, urllib; assert sys.version_info >= (3, 11); print(sys.executable)' 2>/dev/null && return 0
    done
    return 1
}

find_python && exit 0

packages="python3 python3-venv"
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "No Python of at least 3.11 here; installing $packages" >&2
    { apt-get -qq update && DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends $packages; } >&2
    find_python && exit 0
fi

found=$(python3 --version 2>/dev/null || echo "no python3")
echo "SLAM Hive needs Python 3.11 or newer, found $found." >&2
echo "Debian 12+, Ubuntu 24.04+: sudo apt-get install $packages" >&2
echo "Ubuntu 22.04: sudo apt-get install python3.11 python3.11-venv   (from the universe repository)" >&2
echo "If one is installed elsewhere: make ... PYTHON=/path/to/python" >&2
exit 1

#!/bin/sh
# Prints the path of a Python of at least 3.11. PYTHON=/path/to/python chooses one.
# Otherwise it is the first that was built with optimisation, which pyenv leaves out; the others take 15 % longer.
# (The python3-minimal of some images lacks half the standard library and does not count.)
# As root on Debian or Ubuntu it installs one where there is none; otherwise it names the command.
set -u

usable='import json, sys, urllib; assert sys.version_info >= (3, 11)'
# Distributions optimise theirs, whatever its configuration says. It must be able to make environments as it is.
fast='import ensurepip, sysconfig
assert sys.base_prefix == "/usr" or "--enable-optimizations" in (sysconfig.get_config_var("CONFIG_ARGS") or "")'

find_python() {
    chosen=
    for candidate in "${PYTHON:-}" python3 python3.11 python3.12 python3.13 python3.14 /usr/bin/python3; do
        [ -n "$candidate" ] || continue
        found=$("$candidate" -c "$usable; print(sys.executable)" 2>/dev/null) || continue
        chosen=${chosen:-$found}
        if [ "$candidate" = "${PYTHON:-}" ] || "$candidate" -c "$usable; $fast" >/dev/null 2>&1; then
            chosen=$found
            break
        fi
    done
    [ -n "$chosen" ] && echo "$chosen"
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

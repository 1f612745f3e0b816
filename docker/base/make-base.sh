#!/bin/sh
# Writes the files of a minimal Debian image to a tar archive, where no registry offers debian:bookworm-slim:
#   make-base.sh base.tar && docker import base.tar slam-hive-base:bookworm
# Needs root and debootstrap. MIRROR, if set, is the Debian mirror to use.
set -eu
archive="${1:?the name of the archive to write is missing}"
command -v debootstrap >/dev/null || { echo "debootstrap is missing; install it: apt-get install debootstrap" >&2; exit 1; }
root="$(mktemp -d)"
trap 'rm -rf "$root"' EXIT
echo "making a minimal Debian with debootstrap"
# The public image has the same settings: no documentation, no translations, no packages kept after they are installed,
# and no flush to the disk for each file. They hold for what is installed here and in all images on top.
mkdir -p "$root/etc/dpkg/dpkg.cfg.d" "$root/etc/apt/apt.conf.d"
printf '%s\n' force-unsafe-io 'path-exclude=/usr/share/doc/*' 'path-include=/usr/share/doc/*/copyright' \
  'path-exclude=/usr/share/man/*' 'path-exclude=/usr/share/locale/*' > "$root/etc/dpkg/dpkg.cfg.d/small"
printf '%s\n' 'Acquire::Languages "none";' 'Binary::apt-get::APT::Keep-Downloaded-Packages "false";' \
  > "$root/etc/apt/apt.conf.d/small"
# shellcheck disable=SC2086 # MIRROR is empty or one word
debootstrap --variant=minbase bookworm "$root" ${MIRROR:-}
rm -rf "$root"/var/cache/apt/archives/*.deb "$root"/var/lib/apt/lists/* "$root"/usr/share/doc/* "$root"/usr/share/man/* \
  "$root"/usr/share/locale/*
tar -C "$root" -cf "$archive" .

#!/bin/sh
# Writes the files of a minimal Debian image to a tar archive, where no registry offers debian:bookworm-slim:
#   make-base.sh base.tar && docker import base.tar slam-hive-base:bookworm
# Root makes it with debootstrap or mmdebstrap, other users with mmdebstrap in a user namespace. It says which way it
# takes and why, or in one line what is missing. MIRROR, if set, is the Debian mirror to use.
#   make-base.sh --check
# does only that, and makes nothing.
set -eu
archive="${1:?the name of the archive to write is missing}"
KEYRING=/usr/share/keyrings/debian-archive-keyring.gpg
# The PATH of Debian's users has no folders of the administrator, where debootstrap lies.
PATH="$PATH:/usr/local/sbin:/usr/sbin:/sbin"
number="$(id -u)" user="$(id -un)"

has() { command -v "$1" >/dev/null 2>&1; }
stop() { echo "$1" >&2; exit 1; }

missing=
need() { missing="$missing $1"; }
# apt of Ubuntu knows no keys of Debian.
[ -e "$KEYRING" ] || need debian-archive-keyring
if [ "$number" = 0 ]; then
  sudo=
  if has debootstrap; then way=debootstrap why="this is root"
  elif has mmdebstrap; then way=root why="this is root, and debootstrap is missing"
  else need debootstrap
  fi
else
  sudo="sudo " way=unshare why="only root can use debootstrap"
  has mmdebstrap || need mmdebstrap
  has newuidmap || need uidmap
fi
[ -z "$missing" ] || stop "missing:$missing; ${sudo}apt-get install$missing"
if [ "$way" = unshare ]; then
  unshare --user --map-root-user true 2>/dev/null || stop "user namespaces are forbidden here, so only root can make the\
 base image: sudo sh docker/base/make-base.sh base.tar && docker import base.tar slam-hive-base:bookworm"
  if ! grep -q "^$user:" /etc/subuid || ! grep -q "^$user:" /etc/subgid; then
    stop "$user has no user numbers for a namespace; sudo usermod --add-subuids 100000-165535 --add-subgids\
 100000-165535 $user"
  fi
fi
case "$way" in
  debootstrap) echo "making a minimal Debian with debootstrap ($why)" ;;
  root) echo "making a minimal Debian with mmdebstrap ($why)" ;;
  unshare) echo "making a minimal Debian with mmdebstrap in a user namespace ($why)" ;;
esac
[ "$archive" != --check ] || exit 0

# The public image has the same settings: no documentation, no translations, no packages kept after they are installed,
# and no flush to the disk for each file. They hold for what is installed here and in all images on top.
dpkg_settings() {
  printf '%s\n' force-unsafe-io 'path-exclude=/usr/share/doc/*' 'path-include=/usr/share/doc/*/copyright' \
    'path-exclude=/usr/share/man/*' 'path-exclude=/usr/share/locale/*'
}
apt_settings() {
  printf '%s\n' 'Acquire::Languages "none";' 'Binary::apt-get::APT::Keep-Downloaded-Packages "false";'
}
# shellcheck disable=SC2016 # expanded by the shell that it is for
tidy='cd "$1" && rm -rf usr/share/doc/* usr/share/man/* usr/share/locale/* var/cache/apt/archives/*.deb var/lib/apt/lists/*'

if [ "$way" != debootstrap ]; then
  # Settings are given as text: root of the namespace cannot read the user's files. Those of apt come last, because
  # mmdebstrap needs the packages that it has downloaded. Devices are left out: a user's engine cannot make them, and
  # each container has a /dev of its own. Without usr-is-merged it would take usrmerge, and with it all of Perl.
  # shellcheck disable=SC2086 # MIRROR is empty or one word
  mmdebstrap --mode="$way" --variant=minbase --dpkgopt="$(dpkg_settings)" --skip=output/dev --include=usr-is-merged \
    --hook-dir=/usr/share/mmdebstrap/hooks/merged-usr --customize-hook="$tidy" \
    --customize-hook="echo '$(apt_settings)' > \"\$1/etc/apt/apt.conf.d/small\"" --format=tar bookworm "$archive" ${MIRROR:-}
  exit 0
fi
root="$(mktemp -d)"
trap 'rm -rf "$root"' EXIT
mkdir -p "$root/etc/dpkg/dpkg.cfg.d" "$root/etc/apt/apt.conf.d"
dpkg_settings > "$root/etc/dpkg/dpkg.cfg.d/small"
apt_settings > "$root/etc/apt/apt.conf.d/small"
# shellcheck disable=SC2086 # MIRROR is empty or one word
debootstrap --variant=minbase bookworm "$root" ${MIRROR:-}
sh -c "$tidy" tidy "$root"
tar -C "$root" -cf "$archive" .

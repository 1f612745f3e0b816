#!/bin/sh
# First layer of every algorithm image, the same for all, so that they share it: Python and what the runtime needs.
# /build/ca-certificates may hold certificates of private authorities.
set -eu
apt-get update
apt-get install -y --no-install-recommends ca-certificates python3 python3-pip
rm -rf /var/lib/apt/lists/*
cp /build/ca-certificates/*.crt /usr/local/share/ca-certificates/ 2>/dev/null || true
update-ca-certificates
pip() { python3 -m pip install --no-cache-dir --no-compile --break-system-packages "$@"; }
export PIP_CERT="${PIP_CERT:-/etc/ssl/certs/ca-certificates.crt}" PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore
pip --requirement /build/requirements.txt

#!/bin/sh
# Run while the web and worker images are built: Python, the certificates passed in, SLAM Hive in /opt/slamhive.
# EXTRAS, if set, names more of what pyproject.toml lists as optional, separated by commas.
set -eu
apt-get update
DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends ca-certificates python3 python3-venv
rm -rf /var/lib/apt/lists/*
cp /source/docker/ca-certificates/*.crt /usr/local/share/ca-certificates/ 2>/dev/null || true
update-ca-certificates
export PIP_CERT="${PIP_CERT:-/etc/ssl/certs/ca-certificates.crt}" PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
python3 -m venv /opt/slamhive
/opt/slamhive/bin/python /source/tools/installer.py /opt/slamhive/bin/python \
    -c /source/constraints.txt "/source${EXTRAS:+[$EXTRAS]}"
# Nobody runs the tests of libraries, which pip would compile too.
/opt/slamhive/bin/python -m compileall -q -j 0 -x /tests/ /opt/slamhive/lib || true
/opt/slamhive/bin/slamhive --version

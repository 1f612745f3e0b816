#!/bin/sh
# Run while the web and worker images are built: the certificates passed in, and SLAM Hive in /opt/slamhive.
# EXTRAS, if set, names more of what pyproject.toml lists as optional, separated by commas.
set -eu
cp /source/docker/ca-certificates/*.crt /usr/local/share/ca-certificates/ 2>/dev/null || true
update-ca-certificates
export PIP_CERT="${PIP_CERT:-/etc/ssl/certs/ca-certificates.crt}" PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
python3 -m venv /opt/slamhive
/opt/slamhive/bin/python /source/tools/installer.py /opt/slamhive/bin/python \
    -c /source/constraints.txt "/source${EXTRAS:+[$EXTRAS]}"
# Not what nobody loads here: the tests of libraries, and what installs, writes fonts and colours source code.
/opt/slamhive/bin/python -m compileall -q -j 0 -x '/(tests|pip|setuptools|fontTools|pygments/lexers)/' \
    /opt/slamhive/lib || true
/opt/slamhive/bin/slamhive --version

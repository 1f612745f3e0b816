"""Time to send a recording to a server, as a multiple of copying and hashing it here, and the memory.

``python benchmarks/uploads.py [MB]``: a file of so many megabytes (default 400) goes to a server on this machine.
"""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

from slamhive.client.http import HttpBackend, send_file
from slamhive.services.hive import open_hive
from slamhive.web.serve import WebServer

PIECE = 1_000_000


def main(megabytes: int) -> None:
    """Print both times, their ratio, and how much memory of this process, which is client and server, grew."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "walk.bag"
        with file.open("wb") as stream:
            for _ in range(megabytes):
                stream.write(os.urandom(PIECE))
        hive = open_hive({"data": str(folder / "data")})
        server = WebServer(hive, "127.0.0.1", 0)
        thread = threading.Thread(target=server.run)
        thread.start()
        backend = HttpBackend(server.url, None)
        try:
            before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            copied_s = timed_copy(file, folder / "copy.bag")
            began = time.monotonic()
            upload = send_file(backend._send, file)
            sent_s = time.monotonic() - began
            assert upload.received_bytes == file.stat().st_size
            grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1000
        finally:
            backend.close()
            server.close()
            thread.join()
            hive.close()
        print(f"{megabytes} MB: copy and hash {copied_s:.2f} s, upload {sent_s:.2f} s ({megabytes / sent_s:.0f} MB/s)")
        print(f"ratio {sent_s / copied_s:.2f}, memory grew by {grown_mb:.0f} MB")


def timed_copy(source: Path, target: Path) -> float:
    """Seconds for a copy that is on the disk, and the SHA-256."""
    began = time.monotonic()
    with source.open("rb") as stream:
        hashlib.file_digest(stream, "sha256")
    shutil.copyfile(source, target)
    descriptor = os.open(target, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)
    return time.monotonic() - began


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)

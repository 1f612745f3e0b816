"""The Python environment of an algorithm package, and the paths of the container contract, where no container is.

``<data>/environments/<package>-<hash>/`` holds ``venv/``, ``prepared/`` (what the package's ``prepare.py`` made) and
``ready``, written last: a folder without it is the remains of a build that was killed, and is made again. A virtual
environment knows its own path and therefore cannot be renamed, so it is built in place under a lock.
``<data>/environments/runtime-<hash>/`` holds the few modules that algorithms may import from this project, and
``runtime-packages-<hash>/`` the packages that those need. Each environment begins with a copy of these packages:
installing them takes ten times longer.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import slamhive
from slamhive.base.debian import install_command
from slamhive.base.errors import Unavailable
from slamhive.base.files import hash_files, sweep_folder, temporary_folder
from slamhive.domain.algorithm import AlgorithmPackage
from slamhive.executors.base import ExecutorContext, ImageMissing, ProgressCallback
from slamhive.executors.build_program import run_program
from slamhive.executors.process.shim_spec import ShimSpec
from slamhive.executors.spec import RunSpec
from slamhive.executors.transfer import make_own_copies, read_places, written_places
from slamhive.packages.image_context import RUNTIME_PARTS, copy_parts

REQUIREMENTS_FILE = "requirements.txt"
NO_DEPS_FILE = "requirements-no-deps.txt"
"""What is installed without its dependencies, because they are large and not needed."""
PREPARE_SCRIPT = "prepare.py"
PREPARE_VARIABLE = "SLAMHIVE_PREPARE_DIR"
RUNTIME_REQUIREMENTS = Path("runtime") / REQUIREMENTS_FILE

_READY = "ready"
_STAGED = ".runtime-"
_COMMON = "runtime-packages-"
_HASH_DIGITS = 12
_NOT_PREPARED_FROM = frozenset({"slamhive", "algorithm.yaml", "Dockerfile", "README.md", "__pycache__"})
_FIND_LIBRARIES = """
import ctypes, sys
for name in sys.argv[1:]:
    try:
        ctypes.CDLL(name)
    except OSError:
        print(name)
"""


@dataclass(frozen=True, slots=True)
class Environment:
    """Where the parts of one environment lie."""

    folder: Path
    runtime: Path

    @property
    def python(self) -> Path:
        """The interpreter."""
        return self.folder / "venv" / "bin" / "python"

    @property
    def prepared(self) -> Path:
        """The folder that ``prepare.py`` filled."""
        return self.folder / "prepared"

    @property
    def ready(self) -> bool:
        """Both parts are complete."""
        return (self.folder / _READY).is_file() and self.runtime.is_dir()


class Environments:
    """All environments of a data root."""

    def __init__(self, data: Path) -> None:
        self._root = data / "environments"

    def identity(self, package: AlgorithmPackage) -> str:
        """``<environment hash>-<runtime hash>``: what a run of ``package`` would use now."""
        return f"{_environment_hash(package)}-{_short_hash(_package_folder(), RUNTIME_PARTS)}"

    def find(self, package_name: str, identity: str) -> Environment:
        """The environment with this identity, ready or not."""
        environment_hash, _, runtime_hash = identity.partition("-")
        return Environment(self._root / f"{package_name}-{environment_hash}", self._root / f"runtime-{runtime_hash}")

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Make what is missing; returns the identity. Raises ImageMissing naming what went wrong and the remedy."""
        if package.system_libraries:
            command = [sys.executable, "-c", _FIND_LIBRARIES, *package.system_libraries]
            missing = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
            if missing:
                installing = install_command(package.system_packages)
                remedy = f"{installing}, or use Docker" if package.system_packages else "install them, or use Docker"
                raise ImageMissing(f"{package.name} needs {', '.join(missing)}, which this machine lacks", remedy)
        identity = self.identity(package)
        environment = self.find(package.name, identity)
        if environment.ready:
            return identity
        with self._locked(environment.folder.name):
            if not (environment.folder / _READY).is_file():
                self._make(package, environment, progress)
            if not environment.runtime.is_dir():
                # The modules that algorithms may import are copied aside, then renamed.
                target = environment.runtime
                try:
                    with temporary_folder(_STAGED, target.parent) as staged:
                        copy_parts(_package_folder(), RUNTIME_PARTS, staged / "slamhive")
                        staged.chmod(0o755)
                        staged.rename(target)
                except OSError as error:
                    if not target.is_dir():
                        problem = f"{target} cannot be written: {error.strerror}"
                        raise Unavailable(problem, "check space and rights") from None
        return identity

    def remove(self, package_name: str, identity: str) -> None:
        """Remove an environment; one that is being built stays. The runtime stays: all packages share it."""
        folder = self.find(package_name, identity).folder
        try:
            with self._locked(folder.name, wait=False):
                shutil.rmtree(folder, ignore_errors=True)
        except BlockingIOError:
            return

    def sweep(self) -> None:
        """Remove what killed builds have left behind."""
        for staged in self._root.glob(f"{_STAGED}*"):
            sweep_folder(staged)
        for folder in self._root.glob("[!.]*"):
            if folder.name.startswith("runtime-") or (folder / _READY).is_file():
                continue
            try:
                with self._locked(folder.name, wait=False):
                    if not (folder / _READY).is_file():
                        shutil.rmtree(folder, ignore_errors=True)
            except BlockingIOError:
                continue  # it is being built

    def _make(self, package: AlgorithmPackage, environment: Environment, progress: ProgressCallback) -> None:
        shutil.rmtree(environment.folder, ignore_errors=True)
        environment.prepared.mkdir(parents=True)
        progress(f"{package.name}: making its Python environment")
        own = environment.folder / "venv"
        venv.EnvBuilder(symlinks=True, with_pip=False).create(own)
        with self._common_packages(package, progress) as common:
            try:
                shutil.copytree(common, sysconfig.get_path("purelib", "venv", {"base": str(own)}), dirs_exist_ok=True)
            except OSError as error:
                why = error.args[0][0][2] if isinstance(error, shutil.Error) else error.strerror
                raise Unavailable(f"{own} cannot be written: {why}", "check space and rights") from None
        pip = _pip("--python", str(environment.python))
        needed = package.folder / REQUIREMENTS_FILE
        if re.search(r"^\s*[^\s#]", needed.read_text(encoding="utf-8"), re.MULTILINE):
            # With those of the runtime, so that pip refuses what contradicts them.
            command = [*pip, *_requirements(needed, _package_folder() / RUNTIME_REQUIREMENTS)]
            _run_step(f"{package.name}: pip install", command, {}, progress)
        alone = package.folder / NO_DEPS_FILE
        if alone.is_file():
            command = [*pip, "--no-deps", *_requirements(alone)]
            _run_step(f"{package.name}: pip install --no-deps", command, {}, progress)
        script = package.folder / PREPARE_SCRIPT
        if script.is_file():
            variables = {PREPARE_VARIABLE: str(environment.prepared), "PYTHONPATH": str(_package_folder().parent)}
            _run_step(f"{package.name}: {PREPARE_SCRIPT}", [str(environment.python), str(script)], variables, progress)
        (environment.folder / _READY).touch()

    @contextmanager
    def _common_packages(self, package: AlgorithmPackage, progress: ProgressCallback) -> Iterator[Path]:
        """The folder with what the runtime needs, made if it is not there; nobody removes it during the block."""
        wanted = _package_folder() / RUNTIME_REQUIREMENTS
        digest = hashlib.sha256(f"{sys.version} {sys.prefix}".encode() + wanted.read_bytes())
        folder = self._root / f"{_COMMON}{digest.hexdigest()[:_HASH_DIGITS]}"
        with self._locked(folder.name):
            if not folder.is_dir():
                with temporary_folder(_STAGED, self._root) as staged:
                    install = [*_pip(), "--target", str(staged / "packages"), *_requirements(wanted)]
                    _run_step(f"{package.name}: pip install for all environments", install, {}, progress)
                    os.sync()  # all later environments are copies: none may begin with files that a power cut emptied
                    (staged / "packages").rename(folder)
                for other in set(self._root.glob(f"{_COMMON}*")) - {folder}:  # of another Python or an older runtime
                    with contextlib.suppress(BlockingIOError), self._locked(other.name, wait=False):
                        shutil.rmtree(other, ignore_errors=True)
            yield folder

    @contextmanager
    def _locked(self, name: str, *, wait: bool = True) -> Iterator[None]:
        """One builder at a time; the kernel frees the lock of a killed one. Without ``wait`` raises BlockingIOError."""
        try:
            self._root.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self._root / f".{name}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise Unavailable(f"{self._root} cannot be used: {error.strerror}", "check space and rights") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield
        finally:
            os.close(descriptor)


def pip_problem() -> str | None:
    """Why no environment could be made on this machine; None if it can."""
    if importlib.util.find_spec("pip") is None:
        return f"{sys.executable} has no pip; install it with: {sys.executable} -m ensurepip"
    return None


def _package_folder() -> Path:
    return Path(slamhive.__file__).parent


def _pip(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "pip", *arguments, "--disable-pip-version-check", "install", "--no-input"]


def _requirements(*files: Path) -> list[str]:
    return [argument for file in files for argument in ("--requirement", str(file))]


def _environment_hash(package: AlgorithmPackage) -> str:
    requirements = package.folder / REQUIREMENTS_FILE
    if not requirements.is_file():
        raise ImageMissing(
            f"{package.name} has no {REQUIREMENTS_FILE}: it runs in its container only",
            "use an executor of containers; slamhive doctor --all lists them",
        )
    digest = hashlib.sha256(f"{sys.version} {sys.prefix}".encode())
    digest.update(requirements.read_bytes())
    for more in (package.folder / NO_DEPS_FILE, _package_folder() / RUNTIME_REQUIREMENTS):
        if more.is_file():
            digest.update(more.read_bytes())
    if (package.folder / PREPARE_SCRIPT).is_file():
        names = [path.name for path in sorted(package.folder.iterdir()) if path.name not in _NOT_PREPARED_FROM]
        digest.update(_short_hash(package.folder, names).encode())
    return digest.hexdigest()[:_HASH_DIGITS]


def _short_hash(root: Path, parts: Iterable[str]) -> str:
    return hash_files(root, parts).removeprefix("sha256:")[:_HASH_DIGITS]


def _run_step(title: str, command: list[str], variables: dict[str, str], progress: ProgressCallback) -> None:
    """Run one build step, its output line by line to ``progress``; raises ImageMissing with its last lines."""
    inherited = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    last: deque[str] = deque(maxlen=4)

    def show(line: str) -> None:
        if not last or line != last[-1]:
            last.append(line)
        progress(f"{title}: {line}")

    exit_code = run_program(command, {**inherited, "PYTHONUNBUFFERED": "1", **variables}, show)
    if exit_code != 0:
        raise ImageMissing(f"{title} failed with exit code {exit_code}: {' | '.join(last)}")


# -- paths of the container contract for a run without a container -----------------------------------------------------


CONTAINER_ROOT = "/slamhive"
KEY_VARIABLE = "SLAMHIVE_RUN_KEY"
PREPARED_VARIABLE = "SLAMHIVE_PREPARED"
INHERITED = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "OMP_NUM_THREADS", "TZ")
"""Variables of the worker that runs see too."""

_NO_LIMIT_OF_TASKS = 1 << 22
"""More processes and threads than a Linux kernel can have."""


class LocalPaths:
    """Translates paths of the container contract into paths of this machine."""

    def __init__(self, spec: RunSpec) -> None:
        self.writable = written_places(spec)
        self.places = read_places(spec) | self.writable
        self._scripts = spec.package_folder.resolve() / "slamhive"

    def find(self, target: str) -> Path | None:
        """Where ``target`` is: in an input or output, else among the package's scripts; None if it is neither."""
        above = [place for place in self.places if target == place or target.startswith(f"{place}/")]
        if above:
            nearest = max(above, key=len)
            return self.places[nearest] / target[len(nearest) :].lstrip("/")
        if target.startswith(f"{CONTAINER_ROOT}/"):
            return self._scripts / target[len(CONTAINER_ROOT) + 1 :]
        return None

    def translate(self, value: str) -> str:
        """``value``, or its path on this machine if it is a path of the container contract."""
        found = self.find(value) if value.startswith("/") else None
        return value if found is None else str(found)

    def link_dataset(self, folder: Path) -> None:
        """Link what belongs below ``/slamhive/dataset`` into ``folder``, and nothing else."""
        inside = f"{CONTAINER_ROOT}/dataset/"
        for target, place in self.places.items():
            if target.startswith(inside):
                link = folder / target[len(inside) :]
                link.parent.mkdir(parents=True, exist_ok=True)
                link.unlink(missing_ok=True)
                link.symlink_to(place)


def shim_spec_of(
    spec: RunSpec, environment: Environment, work: Path, context: ExecutorContext, containment: str | None
) -> ShimSpec:
    """The orders for the supervisor of ``spec``. Makes the folders and copies that the run needs."""
    home, dataset = work / "home", work / "dataset"
    for folder in (home, dataset):
        folder.mkdir(parents=True, exist_ok=True)
    make_own_copies(spec)
    paths = LocalPaths(spec)
    paths.link_dataset(dataset)
    variables = {
        **{key: os.environ[key] for key in INHERITED if key in os.environ},
        "HOME": str(home),
        "TMPDIR": str(home),
        "PYTHONPATH": str(environment.runtime),
        "PYTHONUNBUFFERED": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
        "SLAMHIVE_CONFIG": str(paths.find(f"{CONTAINER_ROOT}/config.yaml")),
        "SLAMHIVE_DATASET": str(dataset),
        "SLAMHIVE_RESULT": str(paths.find(f"{CONTAINER_ROOT}/result")),
        PREPARED_VARIABLE: str(environment.prepared),
        **{key: paths.translate(value) for key, value in spec.environment.items()},
        KEY_VARIABLE: spec.key,
    }
    program = str(environment.python) if spec.command[0] == "python3" else spec.command[0]
    absolute = [value for value in variables.values() if value.startswith("/") and os.pathsep not in value]
    files = [value for value in absolute if Path(value).exists()]
    return replace(
        orders_for_limits(spec, context),
        command=[program, *map(paths.translate, spec.command[1:])],
        environment=variables,
        folder=str(home),
        readable=[program, *files, *map(str, paths.places.values())],
        writable=[str(home), *map(str, paths.writable.values())],
        containment=containment,
    )


def orders_for_limits(spec: RunSpec, context: ExecutorContext) -> ShimSpec:
    """Orders for the supervisor that say what ``spec`` may use, but not yet what to start."""
    limits = spec.limits
    return ShimSpec(
        command=[],
        environment={},
        folder="",
        cores=None if limits.cpuset is None else list(limits.cpuset),
        memory_bytes=limits.memory_bytes,
        tasks=_NO_LIMIT_OF_TASKS if limits.pids is None else limits.pids,
        file_bytes=limits.file_bytes,
        log_max_bytes=context.log_max_bytes,
        cpu_cores=limits.cpu_cores,
        installation=context.installation,
        key=spec.key,
    )

"""A Git repository whose commits are built: its history, and the files of a commit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from slamhive.analysis.bisection import History
from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.base.files import temporary_folder
from slamhive.documents.gate import CommitDocument
from slamhive.packages.algorithm_file import ALGORITHM_FILE
from slamhive.services.algorithms import git_reason, run_git

SHORT = 10
"""Digits of a hash that people see."""


@dataclass(frozen=True, slots=True)
class PackageSource:
    """Where the package of a commit comes from.

    Attributes:
        folder: Its folder in the repository; the root if it is empty.
        package: A folder of this installation that is the package, apart from the sources; None if the repository holds
            the package itself.
        into: Where in that folder the content of the repository goes.
    """

    folder: str = ""
    package: Path | None = None
    into: str = "source"


class GitRepository:
    """A Git repository, which is only read. Neither its working tree nor its index plays a role.

    Args:
        path: Any folder of it.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_dir():
            raise NotFound(f"{path} is no folder", "give the folder of a Git repository: --repo FOLDER")
        self.path = path.resolve()
        done = run_git(["-C", str(self.path), "rev-parse", "--absolute-git-dir"])
        if done.returncode != 0:
            raise InvalidInput(
                f"{path} is no Git repository: {git_reason(done)}", "give the folder of one: --repo FOLDER"
            )
        self._git_folder = done.stdout.strip()

    def commit(self, revision: str) -> str:
        """The hash of a commit, tag or branch; raises NotFound."""
        asked = ["rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}"]
        found = run_git(["-C", str(self.path), *asked])
        if found.returncode != 0:
            raise NotFound(
                f"the repository has no revision {revision!r}",
                "git log lists them; a shallow clone lacks the older ones",
            )
        return found.stdout.strip()

    def history(self, good: str, bad: str) -> History:
        """The commits in ``bad`` but not in ``good``; raises InvalidInput if ``good`` is no ancestor of ``bad``."""
        if good == bad:
            raise InvalidInput(f"--good and --bad are the same commit, {good[:SHORT]}", "name an older good one")
        if run_git(["-C", str(self.path), "merge-base", "--is-ancestor", good, bad]).returncode != 0:
            older = run_git(["-C", str(self.path), "merge-base", good, bad]).stdout.strip()
            remedy = f"their common ancestor is {older[:SHORT]}" if older else "they have no common ancestor"
            raise InvalidInput(f"the good commit {good[:SHORT]} is no ancestor of the bad one, {bad[:SHORT]}", remedy)
        lines = self._read("rev-list", "--topo-order", "--reverse", "--parents", f"{good}..{bad}").splitlines()
        return History({line.split()[0]: tuple(line.split()[1:]) for line in lines}, bad)

    def describe(self, commit: str) -> CommitDocument:
        """Subject, author and date."""
        text = self._read("show", "--no-patch", "--no-show-signature", "--format=%H%n%an%n%aI%n%s", commit)
        found, author, date, subject = (*text.splitlines(), "", "", "", "")[:4]
        return CommitDocument(commit=found, subject=subject, author=author, date=date)

    def package_folders(self, commit: str) -> list[str]:
        """The folders that hold an ``algorithm.yaml``."""
        names = self._read("ls-tree", "-r", "-z", "--name-only", commit).split("\0")
        return sorted(str(PurePosixPath(name).parent) for name in names if PurePosixPath(name).name == ALGORITHM_FILE)

    def tree(self, commit: str, folder: str) -> str | None:
        """The hash of a folder's content; None if the commit has no such folder."""
        path = "" if folder in ("", ".") else folder
        found = run_git(["-C", str(self.path), "rev-parse", "--verify", "--quiet", f"{commit}:{path}"])
        return found.stdout.strip() if found.returncode == 0 else None

    def check_out(self, tree: str, folder: Path) -> None:
        """Write the files of a tree to an empty folder, with an index of its own. Submodules stay empty."""
        with temporary_folder() as aside:
            places = {
                "GIT_DIR": self._git_folder,
                "GIT_WORK_TREE": str(folder),
                "GIT_INDEX_FILE": str(aside / "index"),
            }
            for arguments in (["read-tree", tree], ["checkout-index", "--all", "--quiet"]):
                done = run_git(["-C", str(folder), *arguments], places)
                if done.returncode != 0:
                    raise Unavailable(f"{tree[:SHORT]} cannot be checked out: {git_reason(done)}", "run git fsck")

    def _read(self, *arguments: str) -> str:
        done = run_git(["-C", str(self.path), *arguments])
        if done.returncode != 0:
            raise Unavailable(f"{self.path} cannot be read: {git_reason(done)}", "run git fsck")
        return done.stdout

"""One program at a time has a port, whoever it belongs to and wherever it was started: the locks lie in a folder of the machine."""

import fcntl
import hashlib
import json
import os
import re
import signal
import stat
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from rig.errors import RunError

PLACES = ("/run/lock", "/tmp")
"""Where the folder of the locks may lie: the first that everybody may write to. Not $TMPDIR, which is not the same for all."""

FOLDER = "petal-rig-ports"
PATIENCE_S = 0.3
"""How long a port may be held by a program that only looks before it counts as in use."""

LOOK_S = 0.02

_SHARED_FILE = 0o666
_SHARED_FOLDER = 0o1777
_HERE = re.compile(r"localhost|ip6-localhost|127\.\d+\.\d+\.\d+|0\.0\.0\.0|\[::1?\]")


@dataclass(frozen=True)
class Owner:
    """A program that has ports.

    Attributes
    ----------
    pid : int
    command : str
        As it was typed.
    ports : tuple of str
        Those it has, as `canonical` writes them.
    since : float, s
        When it took the first of them (`time.time`).
    """

    pid: int
    command: str
    ports: tuple[str, ...]
    since: float = 0.0

    def __str__(self) -> str:
        return f"process {self.pid} ({self.command})"

    def terminate(self) -> None:
        """Ask it to stop all axes and to end (SIGTERM).

        Raises
        ------
        RunError
            It belongs to somebody else.
        """
        try:
            os.kill(self.pid, signal.SIGTERM)
        except ProcessLookupError:
            pass
        except PermissionError as exc:
            raise RunError(f"{self} belongs to another user and cannot be told to end from here") from exc

    def await_end(self, timeout_s: float) -> bool:
        """Wait until it has none of its ports any more; return whether that came."""
        deadline = time.monotonic() + timeout_s
        while any(owner.pid == self.pid for owner in owners(self.ports)):
            if time.monotonic() > deadline:
                return False
            time.sleep(LOOK_S)
        return True


class PortInUse(RunError):
    """Another program has a port that was to be claimed.

    Attributes
    ----------
    owner : Owner or None
        None where it has not said who it is.
    """

    def __init__(self, port: str, owner: Owner | None) -> None:
        who = str(owner) if owner else "another program"
        super().__init__(f"the bench is in use by {who}, which has {port}; wait for it, or `rig stop` ends it with all axes stopped")
        self.owner = owner


def canonical(port: str) -> str:
    """Return what all names of one port have in common: a device's real path, a URL with its host spelt in one way."""
    scheme, mark, rest = port.partition("://")
    if not mark:
        kind, mark, path = port.partition(":")
        return f"folder:{os.path.realpath(path)}" if mark and kind == "folder" else os.path.realpath(port)
    rest = re.split(r"[?#]", rest, maxsplit=1)[0]
    if scheme.lower() in ("spy", "alt"):  # pyserial's wrappings of another port
        return canonical(rest)
    host, colon, number = rest.rstrip("/").lower().rpartition(":")
    return f"{scheme.lower()}://{'127.0.0.1' if _HERE.fullmatch(host) else host}{colon}{number}"


@contextmanager
def claimed(ports: Iterable[str]) -> Iterator[None]:
    """Have ports to ourselves, on the whole machine; the locks end with this process at the latest.

    Raises
    ------
    PortInUse
        Another program has one of them.
    RunError
        The locks cannot be written.
    """
    since = time.time()
    with ExitStack() as stack:
        for port in sorted({canonical(port) for port in ports}):  # in one order, lest two programs wait for each other
            try:
                stack.enter_context(_locked(port, since))
            except OSError as exc:
                trouble = f"other programs cannot be kept off {port}: {exc.strerror or exc}"
                raise RunError(f"{_folder()}: {trouble}; everybody must be able to write there") from exc
        yield


@contextmanager
def _locked(port: str, since: float) -> Iterator[None]:
    path = _lock_file(port)
    file = _lock_patiently(path, port)
    try:
        about = {"pid": os.getpid(), "command": " ".join(["rig", *sys.argv[1:]]), "port": port, "since": since}
        os.ftruncate(file, 0)
        text = json.dumps(about).encode()
        if os.pwrite(file, text, 0) < len(text):
            raise OSError("no space left")
        yield
    finally:
        with suppress(OSError):
            os.ftruncate(file, 0)
            path.unlink()  # another user's stays, and says nothing
        os.close(file)


def _lock_patiently(path: Path, port: str) -> int:
    """Return the lock's file, open and locked."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        file = _open_shared(path)
        if _lock(file, fcntl.LOCK_EX):
            if _is_at(file, path):
                return file
            os.close(file)  # who had it has removed it meanwhile
            continue
        owner = _read(file)
        os.close(file)
        if time.monotonic() > deadline:
            raise PortInUse(port, owner)
        time.sleep(LOOK_S)


def _is_at(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def owners(ports: Iterable[str] | None) -> list[Owner]:
    """Return the programs that have any of `ports`, or, with None, any port of this machine. What cannot be read has no owner."""
    folder = _folder()
    try:
        paths = list(folder.iterdir()) if ports is None else [_lock_file(port) for port in {canonical(port) for port in ports}]
    except OSError:
        return []
    found: dict[int, Owner] = {}
    for path in sorted(paths):
        owner = _owner(path)
        if owner is not None:
            before = found.get(owner.pid, Owner(owner.pid, owner.command, (), owner.since))
            found[owner.pid] = Owner(owner.pid, owner.command, (*before.ports, *owner.ports), min(before.since, owner.since))
    return list(found.values())


def _owner(path: Path) -> Owner | None:
    """Return who holds a lock; what is written in the file of one that nobody holds means nothing."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        return None if _lock(file, fcntl.LOCK_SH) else _read(file)
    finally:
        os.close(file)


def _lock(file: int, how: int) -> bool:
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read(file: int) -> Owner | None:
    try:
        about = json.loads(os.pread(file, 100_000, 0))
        owner = Owner(int(about["pid"]), str(about["command"]), (str(about["port"]),), float(about["since"]))
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return owner if owner.pid > 1 else None


def _folder() -> Path:
    for place in PLACES:
        try:
            if os.stat(place).st_mode & stat.S_IWOTH:
                return Path(place) / FOLDER
        except OSError:
            continue
    return Path(tempfile.gettempdir()) / FOLDER


def _lock_file(port: str) -> Path:
    """Return the lock's path; it can be told from the port, and by people."""
    told = re.sub(r"[^A-Za-z0-9.]+", "-", port).strip("-")[-60:]
    return _folder() / f"{told}-{hashlib.sha256(port.encode()).hexdigest()[:12]}"


def _open_shared(path: Path) -> int:
    """Open a lock's file, which several users may write to, and make it and its folder where they are not there."""
    try:
        path.parent.mkdir()
        path.parent.chmod(_SHARED_FOLDER)  # whatever the umask
    except FileExistsError:
        pass
    how = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    while True:
        try:
            # Without O_CREAT: in a folder of several users Linux lets nobody else's file be opened with it.
            return os.open(path, how)
        except FileNotFoundError:
            try:
                file = os.open(path, how | os.O_CREAT | os.O_EXCL, _SHARED_FILE)
            except FileExistsError:
                continue
            os.fchmod(file, _SHARED_FILE)
            return file

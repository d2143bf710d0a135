"""A camera that a tethering program drives: its RAW files fall into a folder, and each is a reading of the light on a patch of the picture.

The folder takes the place of the port (``folder:/path``). A picture counts only if it arrived after the call: its file's name and its inode
must be new, so that neither an older picture that is renamed or still being written passes for it, nor one that is written over. Whoever
writes the files must therefore give each a name of its own. A file is taken once it has rested for a moment and LibRaw reads it whole.

The picture is taken by a command (gphoto2, say) or by a person. A picture exposed before the call but delivered after it
cannot be told from a later one: press the shutter only when asked.
"""

from __future__ import annotations

import fnmatch
import math
import os
import shlex
import signal
import stat
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.cameras.errors import BadFrame, IncompleteFrame, NotRaw
from drivers.cameras.frame import CHANNELS, NOT_TOLD, Frame, read_frame
from drivers.cameras.patch import DICTIONARY, MARGIN, Statistics, finder, statistics
from drivers.errors import DeviceError, DeviceFault, InvalidSetting, PortClosed, TransportTimeout
from drivers.kinds import Identity, LightReading
from drivers.link import Traffic, Witness
from drivers.motion import Clock

SCHEME = "folder:"
UNIT = "1/s"
POLL_S = 0.05
SATURATED, DARK = 1, 2
"""Status bits of a reading."""

_ASIDE = (".part", ".partial", ".tmp", ".crdownload", "~")  # what programs call a file that is not whole
_NOMINAL = 0.9  # cameras round their exposure times: 1/60 s is 1/64 s
_SIGMAS = 3.0


@dataclass(frozen=True)
class Glimpse:
    """A file in the folder at one moment; one that is written to does not stay the same."""

    inode: int
    size: int
    modified_ns: int


class FolderLink:
    """The folder as a port.

    Parameters
    ----------
    url : str
        ``folder:`` and the path of a folder that exists.
    device : str
        For messages.
    traffic : callable, optional
        Called with (monotonic time in s, ``"tx"``, command) and (monotonic time in s, ``"rx"``, name of the file taken). What it raises
        is logged once and goes no further.
    """

    def __init__(self, url: str, *, device: str = "", timeout_s: float = 1.0, traffic: Traffic | None = None) -> None:
        path = url.removeprefix(SCHEME)
        if path == url or not path:
            raise InvalidSetting(f"port {url!r}", device=device, expected=f"{SCHEME}/path/of/a/folder")
        self.url = url
        self.device = device
        self.timeout_s = timeout_s
        self.path = Path(path.removeprefix("//")).expanduser()
        self.closed = False
        self._witness = Witness(traffic, url)

    @classmethod
    def open(cls, url: str, *, device: str = "", timeout_s: float = 1.0, traffic: Traffic | None = None, **_: Any) -> FolderLink:
        """Make sure that the folder is there; what else a link of lines is told (a report, a terminator) does not matter here.

        Raises
        ------
        TransportTimeout
            There is no such folder.
        InvalidSetting
            The URL is none of a folder.
        """
        link = cls(url, device=device, timeout_s=timeout_s, traffic=traffic)
        if not link.path.is_dir():
            raise TransportTimeout("no such folder", device=device, port=url, attempt="opening the folder", hint="make it, or mount it")
        return link

    def require_open(self, attempt: str) -> None:
        """Raise PortClosed if the link was closed."""
        if self.closed:
            raise PortClosed("the folder was closed", device=self.device, port=self.url, attempt=attempt, hint="open it again")

    def look(self, attempt: str) -> dict[str, Glimpse]:
        """Return what is in the folder now.

        Raises
        ------
        PortClosed
            The folder is gone or cannot be read, or the link was closed.
        """
        self.require_open(attempt)
        found = {}
        try:
            with os.scandir(self.path) as entries:
                for entry in entries:
                    try:
                        status = os.stat(entry.path)  # entry.stat() has no inode on Windows
                        if stat.S_ISREG(status.st_mode):
                            found[entry.name] = Glimpse(status.st_ino, status.st_size, status.st_mtime_ns)
                    except FileNotFoundError:  # gone again already
                        continue
        except OSError as error:
            hint = "was it renamed, or its disk taken away?"
            raise PortClosed(
                f"the folder is gone: {error.strerror}", device=self.device, port=self.url, attempt=attempt, hint=hint
            ) from error
        return found

    def note(self, direction: Any, data: bytes) -> None:
        """Tell the traffic log."""
        self._witness.saw(time.monotonic(), direction, data)

    def close(self) -> None:
        """Let go of the folder; who waits for a file or a command gets `PortClosed` within `POLL_S`. Closing twice is harmless."""
        self.closed = True

    def __enter__(self) -> FolderLink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Arrivals:
    """The files that have come since it was made, and which of them are whole.

    Parameters
    ----------
    link : FolderLink
    pattern : str
        Names that count, as in a shell; case does not matter.
    settle_s : float, s
        How long a file must have rested.
    """

    def __init__(self, link: FolderLink, pattern: str, settle_s: float, attempt: str) -> None:
        self._link, self._pattern, self._settle_s, self._attempt = link, pattern.lower(), settle_s, attempt
        known = link.look(attempt)
        self._names, self._inodes = set(known), {glimpse.inode for glimpse in known.values()}
        self._missing: set[int] = set()
        self._resting: dict[str, tuple[Glimpse, float]] = {}  # since when, in the order of arrival
        self.refused: dict[str, tuple[Glimpse, BadFrame]] = {}

    def take(self, now: float) -> Frame | None:
        """Return the first new frame that is whole, if there is one; `now` in s, never going backwards.

        Raises
        ------
        UnusableFrame
            A whole RAW file has come that cannot be measured with.
        PortClosed
            The folder is gone.
        """
        seen = self._link.look(self._attempt)
        # The next file may get the inode of one that was taken away. Missed twice: a listing may miss a file that is just being renamed.
        missing = self._inodes - {glimpse.inode for glimpse in seen.values()}
        self._inodes -= missing & self._missing
        self._missing = missing
        there = {name: glimpse for name, glimpse in seen.items() if self._counts(name, glimpse)}
        self._resting = {name: rest for name, rest in self._resting.items() if name in there}
        for name in sorted(there, key=lambda name: (there[name].modified_ns, name)):
            if name not in self._resting or self._resting[name][0] != there[name]:
                self._resting[name] = (there[name], now)
        for name, (glimpse, since) in self._resting.items():
            if now - since < self._settle_s or (name in self.refused and self.refused[name][0] == glimpse):
                continue
            try:
                frame = read_frame(self._link.path / name)
            except (IncompleteFrame, NotRaw) as error:
                self.refused[name] = (glimpse, error)
                continue
            if self._link.look(self._attempt).get(name) == glimpse:  # else it was written to while it was read
                return frame
        return None

    def story(self) -> str:
        """What came and why it was not taken."""
        stories = [f"{name}: {error.problem}" for name, (_, error) in self.refused.items()]
        unsettled = [f"{name}: still being written" for name in self._resting if name not in self.refused]
        return "; ".join(stories + unsettled)

    def _counts(self, name: str, glimpse: Glimpse) -> bool:
        if name in self._names or glimpse.inode in self._inodes:
            return False
        return not name.startswith(".") and not name.lower().endswith(_ASIDE) and fnmatch.fnmatchcase(name.lower(), self._pattern)


def judge(found: dict[str, Statistics], channel: str, frame: Frame, iso: float, tolerated: float = 0.0) -> LightReading:
    """Make a reading of one channel: its mean per second at ISO 100.

    Over range when more than the fraction `tolerated` of its pixels are saturated. Under range when the mean is not above black by more
    than three standard errors and half a count, the rounding of the black level. Other channels' saturation is told, no more.
    """
    patch = found[channel]
    flags = tuple(f"{one.saturated} of {one.count} {name} pixels saturated" for name, one in found.items() if one.saturated)
    taken_s = frame.taken.timestamp() if frame.taken else None
    if patch.saturated > tolerated * patch.count:
        return LightReading(math.inf, UNIT, SATURATED, over_range=True, device_time_s=taken_s, flags=flags)
    dark = patch.mean <= _SIGMAS * patch.spread / math.sqrt(patch.count) + frame.step(channel) / 2
    value = patch.mean / frame.exposure_s / (iso / 100)
    return LightReading(
        value,
        UNIT,
        DARK if dark else 0,
        over_range=False,
        under_range=dark,
        device_time_s=taken_s,
        flags=(*flags, "not above black") if dark else flags,
    )


class FolderCamera:
    """The camera as a light sensor; satisfies `drivers.kinds.LightSensor`. It needs a folder of its own.

    A reading is the mean of a patch, as a fraction of the way from black to white, per second of exposure at ISO 100.

    Parameters
    ----------
    link : FolderLink
        Stays the caller's to close.
    name : str
        For messages.
    patch : str
        ``markers`` or ``markers:A,B,C,D`` (ids from the top left clockwise), ``chart:NUMBER`` (1 to 24), or ``X,Y,WIDTH,HEIGHT`` in pixels.
    dictionary, margin
        Of the markers, see `find_markers`.
    channel : str
        ``R``, ``G`` or ``B``.
    integration_s : float, s
        A shorter exposure is refused. The exposure itself is set at the camera and read from the file.
    saturated_fraction : float
        Of the patch's pixels that may be saturated in a good reading.
    iso : float, optional
        For files that do not tell.
    pattern : str
        Names of the files that count.
    patience_s : float, s
        How long to wait for a picture.
    settle_s : float, s
        How long a file must have rested before it is read.
    trigger_command : str, optional
        What takes a picture, such as ``gphoto2 --capture-image-and-download --filename %Y%m%d-%H%M%S.%C``: run in the folder, without a
        shell, once for each reading. Without it somebody presses the shutter.
    trigger_s : float, s
        Time allowed for it.
    clock
        To wait with.
    """

    def __init__(
        self,
        link: FolderLink,
        name: str,
        *,
        patch: str = "markers",
        dictionary: str = DICTIONARY,
        margin: float = MARGIN,
        channel: str = "G",
        integration_s: float = 1e-4,
        saturated_fraction: float = 0.0,
        iso: float | None = None,
        pattern: str = "*",
        patience_s: float = 60.0,
        settle_s: float = 0.2,
        trigger_command: str | None = None,
        trigger_s: float = 60.0,
        clock: Clock = time,
    ) -> None:
        if channel not in CHANNELS:
            raise InvalidSetting(f"channel {channel!r}", device=name, expected=", ".join(CHANNELS))
        if not 0 <= saturated_fraction < 1:
            raise InvalidSetting(f"saturated_fraction {saturated_fraction}", device=name, expected="from 0 to below 1")
        for what, value in (("patience_s", patience_s), ("settle_s", settle_s), ("trigger_s", trigger_s), ("iso", iso)):
            if value is not None and not 0 < value < math.inf:
                raise InvalidSetting(f"{what} {value}", device=name, expected="a finite number above 0")
        self._link, self._name, self._channel = link, name, channel
        self._find = self._told(lambda: finder(patch, dictionary, margin))
        self._tolerated, self._iso = saturated_fraction, iso
        self._pattern, self._patience_s, self._settle_s = pattern, patience_s, settle_s
        self._command, self._trigger_s = self._told(lambda: _words(trigger_command)), trigger_s
        self._clock = clock
        self._lock = threading.Lock()
        self._closed = False
        self._identity = Identity(NOT_TOLD, "camera", NOT_TOLD, NOT_TOLD)
        self._least_s = self._exposure_s = 0.0
        self.configure(integration_s)

    @classmethod
    def open(cls, link: FolderLink, name: str, **options: Any) -> FolderCamera:
        """Make sure that the folder is there; the camera itself is not heard of before its first picture.

        Raises
        ------
        PortClosed
            The folder is gone.
        InvalidSetting
            An option that cannot be.
        """
        camera = cls(link, name, **options)
        camera._told(lambda: link.look("opening the folder"))
        return camera

    @property
    def name(self) -> str:
        """What the user calls it."""
        return self._name

    @property
    def unit(self) -> str:
        """Always 1/s: the fraction of the way from black to white, per second at ISO 100."""
        return UNIT

    @property
    def integration_s(self) -> float:
        """Exposure of the last picture, s; before the first since `configure`, the shortest that will do."""
        return self._exposure_s

    def identify(self) -> Identity:
        """Make sure that the folder is there, and say who took the last picture, as far as its file tells: before it nothing is known.

        Raises
        ------
        PortClosed
            The folder is gone or cannot be read.
        """
        attempt = "looking for the folder"
        self._told(lambda: self._require_open(attempt))
        self._told(lambda: self._link.look(attempt))
        return self._identity

    def configure(self, integration_s: float, range: float | None = None) -> None:
        """Set the shortest exposure that will do: the exposure itself is set at the camera.

        Raises
        ------
        InvalidSetting
            Not above 0 or longer than the patience, or a range.
        """
        if not 0 < integration_s <= self._patience_s:
            expected = f"above 0 and at most {self._patience_s:g} s, the time a picture is waited for"
            raise InvalidSetting(f"integration_s {integration_s}", device=self._name, expected=expected)
        if range is not None:
            raise InvalidSetting(f"range {range}", device=self._name, expected="none: set exposure time and ISO at the camera")
        self._least_s = self._exposure_s = integration_s

    def frame(self) -> Frame:
        """Take a picture, or wait for one; blocks until its file is whole.

        Raises
        ------
        TransportTimeout
            None came, or none that was whole, or the command took too long.
        PortClosed
            The folder is gone; or the link or the device was closed, which also ends the command.
        DeviceFault
            The command failed, or the exposure is shorter than `configure` asked for.
        UnusableFrame
            A picture came that cannot be measured with.
        """
        with self._lock:
            return self._told(self._next)

    def read_channels(self) -> dict[str, LightReading]:
        """Take a picture, or wait for one, and return a reading for each of ``R``, ``G`` and ``B``; see `read`."""
        frame = self.frame()
        return self._told(lambda: self._readings(frame))

    def read(self) -> LightReading:
        """Take a picture, or wait for one, and measure its patch in the chosen channel.

        Raises
        ------
        PatchNotFound
            The markers, the chart or the rectangle are not in the picture.
        DeviceError
            See `frame`.
        """
        return self.read_channels()[self._channel]

    def close(self) -> None:
        """Let go of the camera. The link stays open."""
        self._closed = True

    def _told(self, action: Callable[[], Any]) -> Any:
        """Do it; an error bears our name and port."""
        try:
            return action()
        except DeviceError as error:
            error.complete(device=self._name, port=self._link.url)
            error.device = self._name
            raise

    def _next(self) -> Frame:
        attempt = "waiting for a picture"
        arrivals = Arrivals(self._link, self._pattern, self._settle_s, attempt)
        self._require_open(attempt)
        self._trigger()
        begun = self._clock.monotonic()
        while True:
            self._require_open(attempt)
            now = self._clock.monotonic()
            if frame := arrivals.take(now):
                break
            if now - begun >= self._patience_s:
                story = arrivals.story()
                raise TransportTimeout(
                    f"nothing to take came: {story}" if story else "no new file came",
                    attempt=attempt,
                    expected=f"a whole RAW file {self._pattern} within {self._patience_s:g} s",
                    elapsed_s=now - begun,
                    hint="does the tethering program save here, each picture under a name of its own?",
                )
            self._clock.sleep(POLL_S)
        self._link.note("rx", frame.path.name.encode())
        if frame.exposure_s < _NOMINAL * self._least_s:
            raise DeviceFault(
                f"{frame.path.name} was exposed for {frame.exposure_s:g} s",
                attempt=attempt,
                expected=f"at least {self._least_s:g} s",
                hint="set the camera's exposure time, or a shorter integration time",
            )
        self._identity, self._exposure_s = frame.identity, frame.exposure_s
        return frame

    def _require_open(self, attempt: str) -> None:
        if self._closed:
            raise PortClosed("the device was closed", attempt=attempt, hint="open it again")

    def _trigger(self) -> None:
        if not self._command:
            return
        attempt, command = "taking a picture", shlex.join(self._command)
        self._link.note("tx", command.encode())
        begun = time.monotonic()
        try:
            # A session of its own, so that what the command has started in turn can be ended with it.
            process = subprocess.Popen(
                self._command,
                cwd=self._link.path,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
        except OSError as error:
            raise DeviceFault(f"{command} cannot be run: {error.strerror}", attempt=attempt, hint="check trigger_command") from error
        with _ended(process):
            while (said := _said(process)) is None:
                self._link.require_open(attempt)
                self._require_open(attempt)
                if time.monotonic() - begun > self._trigger_s:
                    raise TransportTimeout(f"{command} takes longer than {self._trigger_s:g} s; it was ended", attempt=attempt)
        if process.returncode:
            told = said.decode("utf-8", "replace").splitlines()
            story = f": {told[-1][:200]}" if told else ""
            raise DeviceFault(f"{command} ended with exit code {process.returncode}{story}", attempt=attempt, hint="check camera and cable")

    def _readings(self, frame: Frame) -> dict[str, LightReading]:
        iso = frame.iso or self._iso
        if iso is None:
            problem = f"{frame.path.name} does not tell its ISO"
            raise DeviceFault(problem, attempt="measuring the patch", hint="give iso, as the camera is set")
        found = statistics(frame, self._find(frame))
        return {channel: judge(found, channel, frame, iso, self._tolerated) for channel in CHANNELS}


def _said(process: subprocess.Popen[bytes]) -> bytes | None:
    """What a command that has ended complained of, or else said; None if it still runs after a moment."""
    try:
        output, complaints = process.communicate(timeout=POLL_S)
    except subprocess.TimeoutExpired:
        return None
    return complaints.strip() or output.strip()


@contextmanager
def _ended(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Leave no command behind, nor what it has started, when there is an error."""
    try:
        yield
    except BaseException:
        if os.name != "posix":
            process.kill()
        elif process.returncode is None:  # else its number may be another's
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for pipe in (process.stdout, process.stderr):
            if pipe is not None:
                pipe.close()
        raise


def _words(command: str | None) -> list[str]:
    try:
        words = shlex.split(command or "")
    except ValueError as error:
        raise InvalidSetting(f"trigger_command {command!r}: {error}", expected="a command line") from error
    if command is not None and not words:
        raise InvalidSetting(f"trigger_command {command!r}", expected="a command line, or none")
    return words

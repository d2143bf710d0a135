"""A headless Chromium, driven over its DevTools protocol."""

from __future__ import annotations

import base64
import itertools
import json
import subprocess
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from websockets.sync.client import connect

WIDTH, HEIGHT = 1000, 640
_PATIENCE_S = 60.0


class Browser:
    """A browser of our own with one page in it; use it with ``with``.

    Attributes
    ----------
    requested : list of str
        Address of everything the page asked for.
    """

    def __init__(self, program: str, profile: Path, *, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        software_gl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-gpu"]
        quiet = [
            "--no-first-run",
            "--disable-extensions",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
        ]
        ours = [f"--window-size={size[0]},{size[1]}", f"--user-data-dir={profile}", "--remote-debugging-port=0"]
        self._process = subprocess.Popen(
            [program, "--headless", "--no-sandbox", "--disable-dev-shm-usage", *software_gl, *quiet, *ours, "about:blank"],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        assert self._process.stderr is not None
        self._errors: IO[str] = self._process.stderr
        url = next(line.split()[-1] for line in self._errors if line.startswith("DevTools listening on"))
        self._socket = connect(url, max_size=None, proxy=None)
        self._numbers = itertools.count(1)
        self._session = ""
        self.requested: list[str] = []
        target = next(each for each in self.ask("Target.getTargets")["targetInfos"] if each["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        shown = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", **shown)
        self.ask("Network.enable")
        self.ask("Page.enable")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result."""
        number = next(self._numbers)
        session = {"sessionId": self._session} if self._session else {}
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters, **session}))
        while True:
            message = json.loads(self._socket.recv(timeout=_PATIENCE_S))
            if message.get("method") == "Network.requestWillBeSent":
                self.requested.append(message["params"]["request"]["url"])
            elif message.get("method") == "Network.webSocketCreated":
                self.requested.append(message["params"]["url"])
            elif message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]

    def open(self, url: str) -> None:
        """Go to a page."""
        self.ask("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; a promise is waited for."""
        done = self.ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait_until(self, condition: str) -> Any:
        """Return the value of a JavaScript expression as soon as it is true, looked at whenever the page draws."""
        patience = int(1000 * _PATIENCE_S)
        return self.run(
            f"""new Promise((done, fail) => {{
                const end = performance.now() + {patience};
                const look = () => {{
                    let value = null;
                    try {{ value = {condition}; }} catch (error) {{ value = null; }}
                    if (value) done(value);
                    else if (performance.now() > end) fail(new Error({json.dumps("never true: " + condition)}));
                    else requestAnimationFrame(look);
                }};
                look();
            }})"""
        )

    def frames(self, n: int = 3) -> None:
        """Let the page draw some times."""
        self.run(f"new Promise(done => {{ let n = {n}; const step = () => --n < 0 ? done(1) : requestAnimationFrame(step); step(); }})")

    def picture(self, file: Path | None = None) -> NDArray[np.uint8]:
        """Take a picture (H, W, 3) of the page, red green blue; keep it as PNG in `file`."""
        data = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            file.write_bytes(data)
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert pixels is not None
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB).astype(np.uint8)

    def click(self, x: float, y: float) -> None:
        """Click with the left button."""
        self.drag((x, y))

    def drag(self, *points: tuple[float, float]) -> None:
        """Press the left button at the first point, move through the others, and let go at the last."""
        self.hover(points[0])
        self.frames(5)  # what lies under the pointer is looked for while drawing
        self.press(points[0])
        for point in points[1:]:
            self.pull(point)
        self.release(points[-1])

    def hover(self, point: tuple[float, float]) -> None:
        """Bring the pointer to a point, no button pressed."""
        self._mouse("mouseMoved", point, buttons=0)

    def press(self, point: tuple[float, float]) -> None:
        """Press the left button."""
        self._mouse("mousePressed", point, button="left", clickCount=1)

    def pull(self, point: tuple[float, float]) -> None:
        """Bring the pointer to a point with the left button pressed, and let the page draw that."""
        self._mouse("mouseMoved", point, button="left")
        self.frames(1)

    def release(self, point: tuple[float, float]) -> None:
        """Let go of the left button."""
        self._mouse("mouseReleased", point, button="left", clickCount=1)

    def key(self, key: str, code: int) -> None:
        """Press and release a named key, e.g. ``ArrowRight``; `code` is its Windows virtual key code."""
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def _mouse(self, kind: str, point: tuple[float, float], **more: Any) -> None:
        self.ask("Input.dispatchMouseEvent", type=kind, x=float(point[0]), y=float(point[1]), **{"buttons": 1, **more})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._session = ""
            self.ask("Browser.close")
        finally:
            self._socket.close()
            self._errors.read()
            self._errors.close()
            try:
                self._process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

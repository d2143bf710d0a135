"""Lines to an instrument without a wire."""

import asyncio


class Recorder:
    """A line whose client says some things and listens."""

    def __init__(self) -> None:
        self.said: asyncio.Queue[bytes] = asyncio.Queue()
        self.heard: list[bytes] = []

    async def read(self) -> bytes:
        return await self.said.get()

    def write(self, data: bytes) -> None:
        self.heard.append(data)

    async def drain(self) -> None:
        return

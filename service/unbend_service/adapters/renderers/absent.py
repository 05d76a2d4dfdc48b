"""The render pool of a node that does not render."""

from __future__ import annotations

import os

from unbend_service.application.ports import Bytes, PoolState, SharedMemory, SharedPicture
from unbend_service.domain.errors import NotServedHere
from unbend_service.domain.frames import Border, Frame
from unbend_service.domain.grid import Grid


class AbsentPool:
    """Port RenderPool without a worker; ready, for what is asked of such a node needs none."""

    async def start(self) -> None:
        """There is nothing to start."""

    async def render(
        self,
        frame: Frame,
        grid: Grid,
        border: Border,
        *,
        affinity: str | None = None,
        deadline_s: float | None = None,
        shared: SharedPicture | None = None,
    ) -> Bytes:
        """Raises NotServedHere."""
        raise _refusal()

    def adopt(self, fd: int, size_bytes: int) -> SharedMemory:
        """Raises NotServedHere."""
        os.close(fd)
        raise _refusal()

    def disown(self, memory: SharedMemory) -> None:
        """There is no memory."""

    def state(self) -> PoolState:
        return PoolState(True, "", None, 0, [])

    async def close(self, grace_s: float) -> None:
        """There is nothing to end."""


def _refusal() -> NotServedHere:
    return NotServedHere("This node estimates only.", allowed="role all or render", setting="role")

"""The ledger: for every camera and trigger index exactly one of pending, recorded, or lost with stage and cause.

The number of triggers comes from the board, never from the frames that were seen.
"""

import threading
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from capture.record import Loss, LossStage

Place = tuple[str, str]
"""A camera's side and name."""
NOT_EXPOSED = "the camera did not expose on this trigger"


@dataclass(frozen=True)
class CameraAccount:
    """One camera's books."""

    triggers: int
    recorded: int
    pending: int
    lost: dict[str, int]  # by stage

    @property
    def lost_total(self) -> int:
        """Frames lost at any stage."""
        return sum(self.lost.values())

    @property
    def balanced(self) -> bool:
        """Whether triggers = recorded + lost."""
        return self.triggers == self.recorded + self.lost_total and not self.pending


class _Account:
    def __init__(self, first_index: int) -> None:
        self.next_index = first_index  # every index below has been decided upon
        self.pending: set[int] = set()
        self.recorded = 0
        self.lost: Counter[str] = Counter()


class Ledger:
    """Thread-safe books of one recording. ``on_loss`` is called, outside the lock, with every loss."""

    def __init__(
        self, places: Iterable[Place], first_index: int, now_ns: Callable[[], int], on_loss: Callable[[Loss], None]
    ) -> None:
        self._first_index = first_index
        self._next_index = first_index  # the board's: one past the last trigger
        self._accounts = {place: _Account(first_index) for place in places}
        self._now_ns = now_ns
        self._on_loss = on_loss
        self._mutex = threading.Lock()

    def leave_out(self, place: Place) -> None:
        """This camera takes no part. Before the first trigger."""
        with self._mutex:
            del self._accounts[place]

    def triggered(self, next_index: int) -> None:
        """The board has given all triggers below ``next_index``."""
        with self._mutex:
            self._next_index = max(self._next_index, next_index)

    def arrived(self, place: Place, index: int, lost_in_delivery: int = 0, why_not_exposed: str = NOT_EXPOSED) -> bool:
        """A frame of ``index`` came from the driver. Every index it skipped is lost.

        Args:
            place: the camera.
            index: the frame's trigger index.
            lost_in_delivery: how many of the skipped ones the camera exposed (its frame counter went on).
            why_not_exposed: cause of the loss of the others.

        Returns:
            False when this index was decided upon before: the frame is a duplicate and must be dropped.
        """
        with self._mutex:
            account = self._accounts[place]
            if index < account.next_index:
                return False
            skipped = range(account.next_index, index)
            account.next_index = index + 1
            account.pending.add(index)
        exposed_from = index - lost_in_delivery
        for missing in skipped:
            if missing < exposed_from:
                self._book(place, missing, LossStage.CAMERA, why_not_exposed)
            else:
                self._book(place, missing, LossStage.USB, "exposed by the camera, never delivered")
        return True

    def recorded(self, place: Place, index: int) -> None:
        """The frame is in the file."""
        with self._mutex:
            account = self._accounts[place]
            account.pending.remove(index)
            account.recorded += 1

    def lost(self, place: Place, index: int, stage: LossStage, cause: str) -> None:
        """A frame that had arrived is lost after all."""
        with self._mutex:
            self._accounts[place].pending.remove(index)
        self._book(place, index, stage, cause)

    def absent(self, place: Place, cause: str) -> None:
        """The camera is gone, or will show no more: what it has not shown of the triggers given so far is lost."""
        account = self._accounts[place]
        with self._mutex:
            missing = range(account.next_index, self._next_index)
            account.next_index = max(account.next_index, self._next_index)
        for index in missing:
            self._book(place, index, LossStage.CAMERA, cause)

    def close(self, next_index: int, cause: str = "no frame came before the recording ended") -> None:
        """No trigger at or above ``next_index`` was given; what never came is lost."""
        self.triggered(next_index)
        for place in self._accounts:
            self.absent(place, cause)

    def settle(self, cause: str) -> None:
        """What arrived and is neither recorded nor lost by now never will be. After the write threads have ended."""
        for place, account in self._accounts.items():
            with self._mutex:
                left = sorted(account.pending)
                account.pending.clear()
            for index in left:
                self._book(place, index, LossStage.WRITER, cause)

    @property
    def next_index(self) -> int:
        """One past the last trigger that the board reported, or that a frame has shown."""
        with self._mutex:
            return max(self._next_index, *(account.next_index for account in self._accounts.values()))

    def decided_below(self, place: Place) -> int:
        """Every trigger below this index has been decided upon for this camera."""
        return self._accounts[place].next_index

    def complete(self, place: Place, next_index: int) -> bool:
        """Whether every trigger below ``next_index`` has been decided upon for this camera."""
        return self.decided_below(place) >= next_index

    def accounts(self) -> dict[Place, CameraAccount]:
        """The books as they stand."""
        with self._mutex:
            return {
                place: CameraAccount(
                    self._next_index - self._first_index, account.recorded, len(account.pending), dict(account.lost)
                )
                for place, account in self._accounts.items()
            }

    def _book(self, place: Place, index: int, stage: LossStage, cause: str) -> None:
        with self._mutex:
            self._accounts[place].lost[stage.name.lower()] += 1
        self._on_loss(Loss(index, self._now_ns(), place[0], place[1], stage.name.lower(), cause))

"""Which keys are down, as told by a page that may fall silent."""

from collections.abc import Iterable


class HeldKeys:
    """The keys of one driver.

    A page tells which keys are down whenever that changes, and again and again while there are any:
    keys of a page that has fallen silent are released. A key that was down only between two steps
    counts for one step, so that a short touch is not lost at a slow control rate.

    Attributes:
        patience: seconds after which keys are released that were not heard of.
    """

    def __init__(self, patience: float = 1.0):
        self.patience = patience
        self._heard = float("-inf")
        self.release()

    def update(self, held: Iterable[str], now: float) -> None:
        """Takes over which keys are down at a time in seconds."""
        held = frozenset(held)
        self._touched |= held - self._held
        self._held = held
        self.hear(now)

    def hear(self, now: float) -> None:
        """Notes that something was heard at a time in seconds, whatever it was."""
        self._heard = now

    def silence(self, now: float) -> float:
        """Returns for how many seconds nothing was heard."""
        return now - self._heard

    def release(self) -> None:
        """Releases all keys."""
        self._held: frozenset[str] = frozenset()
        self._touched: frozenset[str] = frozenset()

    def take(self, now: float) -> frozenset[str]:
        """Returns the keys that count for the next step."""
        if self.silence(now) > self.patience:
            self.release()
        taken = self._held | self._touched
        self._touched = frozenset()
        return taken

"""Simulated time that keeps up with real time, as far as the machine is fast enough."""


class Pace:
    """Says how many steps are due.

    After a short stall steps are made up for; of a longer one the time beyond `max_debt` is lost,
    so that the robot slows down instead of leaping.

    Attributes:
        dt: seconds of a step.
        max_debt: seconds of steps that may be made up for at once.
        speed: simulated by real time over the last second or so, 1 where the machine keeps up.
    """

    def __init__(self, dt: float, max_debt: float = 0.2):
        self.dt, self.max_debt = dt, max_debt
        self.restart(0.0)

    def restart(self, now: float) -> None:
        """Makes the first step due at once, at a time in seconds."""
        self._next = now
        self._window_start, self._window_steps = now, 0
        self.speed = 1.0

    def due(self, now: float) -> int:
        """Returns how many steps to take now; they count as taken."""
        if now < self._next:
            return 0
        owed = 1 + int((now - self._next) / self.dt)
        steps = min(owed, max(1, round(self.max_debt / self.dt)))
        self._next += owed * self.dt
        self._window_steps += steps
        if now - self._window_start >= 1.0:
            simulated = (self._window_steps) * self.dt
            self.speed = min(1.0, simulated / (now - self._window_start))
            self._window_start, self._window_steps = now, 0
        return steps

    def wait(self, now: float) -> float:
        """Returns the seconds until the next step is due, 0 where one is."""
        return max(0.0, self._next - now)

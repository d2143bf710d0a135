"""Motion of an axis: trapezoidal profiles, and the ringing of the mechanics after each stop.

Positions, speeds and accelerations are in one length unit of the caller's choice (the stages use degrees) and seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sim.errors import SimError

Segments = tuple[tuple[float, float], ...]
"""Pieces of constant acceleration: (duration s, acceleration unit/s^2)."""


def to_target(position: float, velocity: float, target: float, speed: float, acceleration: float) -> Segments:
    """Plan the quickest move to rest at `target` from a position and a velocity.

    Parameters
    ----------
    position, velocity : float
        Where the axis is and how fast it moves, either sign.
    target : float
        Where it shall stand still.
    speed, acceleration : float
        Limits, above zero. A velocity above `speed` at the start is braked down to it first.

    Returns
    -------
    Segments
        Brake or accelerate, cruise, brake; pieces of no length are left out.
    """
    distance = target - position
    excess = distance - velocity * abs(velocity) / (2 * acceleration)  # what is left if the axis braked now
    if excess == 0:
        return to_rest(velocity, acceleration)
    way = math.copysign(1.0, excess)
    start, room = way * velocity, way * distance  # now the move ends in the positive direction
    peak = min(speed, math.sqrt(max(0.0, acceleration * room + start * start / 2)))
    first = abs(peak - start) / acceleration
    swept = first * (peak + start) / 2
    cruise = max(0.0, (room - swept - peak * peak / (2 * acceleration)) / peak) if peak > 0 else 0.0
    push = acceleration if peak >= start else -acceleration
    pieces = ((first, way * push), (cruise, 0.0), (peak / acceleration, -way * acceleration))
    return tuple(piece for piece in pieces if piece[0] > 0)


def to_rest(velocity: float, acceleration: float) -> Segments:
    """Plan to brake to a standstill."""
    return ((abs(velocity) / acceleration, -math.copysign(acceleration, velocity)),) if velocity else ()


def to_velocity(velocity: float, wanted: float, acceleration: float) -> Segments:
    """Plan to change to the velocity `wanted` and keep it for ever."""
    change = wanted - velocity
    ramp = ((abs(change) / acceleration, math.copysign(acceleration, change)),) if change else ()
    return (*ramp, (math.inf, 0.0)) if wanted else ramp


@dataclass(frozen=True)
class Profile:
    """A planned motion: from `position` and `velocity` at time `start` through `segments`, then rest."""

    start: float
    position: float
    velocity: float
    segments: Segments = ()

    @property
    def duration(self) -> float:
        """How long the motion takes, s."""
        return math.fsum(duration for duration, _ in self.segments)

    @property
    def end(self) -> float:
        """When the motion ends, s."""
        return self.start + self.duration

    def at(self, t: float) -> tuple[float, float]:
        """Return position and velocity at time `t`; before the start, those of the start at rest."""
        position, velocity, left = self.position, self.velocity, t - self.start
        if left < 0:
            return position, 0.0
        for duration, acceleration in self.segments:
            step = min(left, duration)
            position += (velocity + acceleration * step / 2) * step
            if left < duration:
                return position, velocity + acceleration * step
            velocity += acceleration * step
            left -= duration
        return position, 0.0

    def reach(self, begin: float, end: float) -> tuple[float, float]:
        """Return the lowest and the highest position between two times, exactly: each piece is a parabola, whose turning point is known."""
        positions = [self.at(begin)[0], self.at(end)[0]]
        position, velocity, start = self.position, self.velocity, self.start
        for duration, acceleration in self.segments:
            if start >= end:
                break
            turn = -velocity / acceleration if acceleration else 0.0
            for since in (0.0, turn):
                if 0 <= since <= duration and begin <= start + since <= end:
                    positions.append(position + (velocity + acceleration * since / 2) * since)
            if duration == math.inf:
                break
            position += (velocity + acceleration * duration / 2) * duration
            velocity += acceleration * duration
            start += duration
        return min(positions), max(positions)

    @property
    def brake_time(self) -> float:
        """How long the last braking takes, s."""
        return self.segments[-1][0] if self.segments else 0.0

    @property
    def braking(self) -> float:
        """Acceleration of the last piece: its sign is against the direction of arrival."""
        return self.segments[-1][1] if self.segments else 0.0


@dataclass(frozen=True)
class Ringing:
    """Damped oscillation left in the mechanics when a motion ends.

    Parameters
    ----------
    amplitude : float
        First swing (before damping) after a stop that braked for at least one period; shorter braking excites it in proportion.
    decay : float
        Time constant, s.
    frequency : float
        Hz.
    """

    amplitude: float = 0.02
    decay: float = 0.05
    frequency: float = 25.0

    def __post_init__(self) -> None:
        if not (self.amplitude >= 0 and self.decay > 0 and self.frequency > 0):
            raise SimError(f"ringing {self}: amplitude must be zero or more, decay and frequency above zero")

    def after(self, move: Profile, t: float) -> float:
        """Return the deflection at time `t` left by a motion that ended as planned."""
        since = t - move.end
        if since < 0 or not self.amplitude:
            return 0.0
        strength = self.amplitude * min(1.0, self.frequency * move.brake_time)
        swing = strength * math.exp(-since / self.decay) * math.sin(2 * math.pi * self.frequency * since)
        return swing if move.braking < 0 else -swing  # the first swing goes on in the direction of arrival


@dataclass(frozen=True)
class _Move:
    profile: Profile
    until: float = math.inf  # when another motion took over
    before: tuple[float, float] = (math.inf, -math.inf)  # lowest and highest position of all earlier motions


class Track:
    """All that one axis did lately: where it was told to be, and where its mechanics truly were.

    The nominal position follows the profile; the mechanical one adds the ringing. A new motion starts from the nominal position and
    velocity of its moment; the ringing of earlier stops dies away underneath it.

    Parameters
    ----------
    position : float
        Where the axis stands at time 0.
    ringing : Ringing
        What each completed motion leaves behind.
    memory : float
        How long past motions are remembered, s.
    """

    def __init__(self, position: float, ringing: Ringing, memory: float = 3600.0) -> None:
        self.ringing = ringing
        self._memory = memory
        # A tuple, replaced and never changed, so that another thread may look at the track at any time.
        self._moves: tuple[_Move, ...] = (_Move(Profile(0.0, position, 0.0)),)

    @property
    def end(self) -> float:
        """When the latest motion ends or ended, s; infinite for an endless one."""
        return self._moves[-1].profile.end

    @property
    def departures(self) -> tuple[float, ...]:
        """When motions that are remembered began from rest, s; what takes over from another one, a stop say, does not count."""
        profiles = [move.profile for move in self._moves]
        return tuple(profile.start for profile in profiles if profile.velocity == 0 and profile.duration > 0)

    def nominal(self, t: float) -> tuple[float, float]:
        """Return the position and velocity of the profile at time `t`.

        Raises
        ------
        SimError
            `t` lies before what is remembered.
        """
        return self._at(t).profile.at(t)

    def _at(self, t: float) -> _Move:
        for move in reversed(self._moves):
            if t >= move.profile.start:
                return move
        raise SimError(f"axis asked where it was at {t:.3f} s; it remembers {self._moves[0].profile.start:.3f} s and later")

    def moving(self, t: float) -> bool:
        """Tell whether a motion was under way at time `t`; the ringing afterwards does not count."""
        return t < self._at(t).profile.end

    def reach(self, t: float, since: float | None = None) -> tuple[float, float]:
        """Return the lowest and the highest nominal position up to time `t`, exactly.

        Parameters
        ----------
        t : float
            What was planned for later, and may yet be changed, does not count.
        since : float, optional
            Look no further back than this, s; otherwise to the beginning, however long ago.

        Raises
        ------
        SimError
            `t` or `since` lies before what is remembered.
        """
        move = self._at(t)
        if since is None or since <= 0:
            low, high = move.profile.reach(move.profile.start, t)
            return min(low, move.before[0]), max(high, move.before[1])
        self._at(since)
        kept = [move for move in self._moves if move.profile.start <= t and move.until >= since]
        ends = [move.profile.reach(max(since, move.profile.start), min(t, move.until)) for move in kept]
        return min(low for low, _ in ends), max(high for _, high in ends)

    def mechanical(self, t: float) -> float:
        """Return the true position of the mechanics at time `t`, ringing included."""
        position = self.nominal(t)[0]
        for move in reversed(self._moves):
            if t - move.until > 20 * self.ringing.decay:
                break
            if move.profile.end <= min(t, move.until):
                position += self.ringing.after(move.profile, t)
        return position

    def begin(self, t: float, segments: Segments) -> None:
        """Start a motion at time `t` from the nominal position and velocity, whatever was going on; `t` may lie ahead.

        What was planned to start later than that is dropped.
        """
        position, velocity = self.nominal(t)
        *past, current = (move for move in self._moves if move.profile.start <= t)
        kept = tuple(move for move in (*past, replace(current, until=t)) if move.until >= t - self._memory)
        self._moves = (*kept, _Move(Profile(t, position, velocity, segments), before=self.reach(t)))

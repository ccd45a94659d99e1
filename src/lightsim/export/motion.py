"""Motion of actors at one time, for the attributes of boxes."""

from __future__ import annotations

import numpy as np

from lightsim.core.actors import ActorTrack

# Speed in m/s below which a vehicle that drives in the log has stopped: above the noise of tracks.
# Chosen; sensitivity not measured.
_MOVES_M_S = 0.3
# Half of the time over which the speed is measured, one sweep of 0.1 s.
_HALF_NS = 50_000_000


def is_moving_at(track: ActorTrack, time_ns: int) -> bool:
    """Return whether an actor moves at a time."""
    ends = track.trajectory.held_at(np.array([time_ns - _HALF_NS, time_ns + _HALF_NS]))
    speed_m_s = float(np.linalg.norm(ends[1, :3, 3] - ends[0, :3, 3])) / (2e-9 * _HALF_NS)
    return speed_m_s > _MOVES_M_S

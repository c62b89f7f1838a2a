"""How a built-in camera goes along with people who travel: by their smoothed ways over the floor.

A built-in camera is a formula of time for a person at the origin. It goes along where a person would leave the picture:
its place is moved by the mean of the avatars' ways. A way repeats as its motion does, so a frame does not depend on
those before it. Steps and sways are smoothed out of it, because a camera that shows them shakes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trilane.arrays import F64
from trilane.body.body import ShapedBody
from trilane.scene.motion.motion import Wrap, bracket, wrapped_time
from trilane.scene.mover import Mover

#: Step between samples of a way, and most samples; a longer motion has longer steps.
STEP_S, MOST_SAMPLES = 0.1, 6000
#: Standard deviation of the Gaussian that smooths a way. It leaves a sixth of a sway of 1 Hz and nothing of a step of
#: 2 Hz; a runner at 6 m/s who turns at once is 1.4 m from the smoothed way.
SMOOTH_S = 0.3
#: Standard deviations after which the Gaussian ends.
ENDS_AFTER = 3.0
#: How an array of samples continues beyond its ends, by what follows the motion's last frame.
PADDING = {Wrap.LOOP: "wrap", Wrap.BOUNCE: "reflect", Wrap.HOLD: "edge"}


@dataclass(frozen=True)
class Way:
    """The smoothed way of an avatar over the floor.

    `times_s` (T,): times from 0, strictly increasing. `places` (T, 3): places on the floor, metres. `wrap`: what
    follows the last one.
    """

    times_s: F64
    places: F64
    wrap: Wrap

    def at(self, t_s: float) -> F64:
        """Return the place (3,) at `t_s`, linear between samples."""
        i, j, fraction = bracket(self.times_s, wrapped_time(t_s, float(self.times_s[-1]), self.wrap))
        return np.asarray(self.places[i] + (self.places[j] - self.places[i]) * fraction)


def way_cycle_s(mover: Mover) -> float:
    """Return the time after which the way of `mover` begins again; that of its motion where it holds its end."""
    return mover.motion.duration_s * (2 if mover.motion.wrap is Wrap.BOUNCE else 1)


def way_of(mover: Mover, body: ShapedBody) -> Way:
    """Return the way of the pelvis of `mover`, who has `body`."""
    motion = mover.motion
    count = min(int(np.ceil(motion.duration_s / STEP_S)), MOST_SAMPLES - 1) + 1
    times = np.linspace(0.0, motion.duration_s, count)
    pelvises = motion.sample_all(times)[1] * mover.scale + mover.shift + body.joints[0]
    places = pelvises @ mover.world[:3, :3].T + mover.world[:3, 3]
    places[:, 1] = 0.0
    return Way(times, smoothed(places, float(times[-1]) / max(count - 1, 1), motion.wrap), motion.wrap)


def smoothed(places: F64, step_s: float, wrap: Wrap) -> F64:
    """Return `places` (T, 3), `step_s` apart, smoothed by a Gaussian; beyond their ends they go on by `wrap`."""
    if len(places) == 1:
        return places
    reach = int(np.ceil(ENDS_AFTER * SMOOTH_S / step_s))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step_s / SMOOTH_S) ** 2)
    weights /= weights.sum()
    # The last sample of a loop is the first one of the next.
    own = places[:-1] if wrap is Wrap.LOOP else places
    padded = np.pad(own, ((reach, reach), (0, 0)), mode=PADDING[wrap])  # type: ignore[call-overload]
    smooth = np.stack([np.convolve(column, weights, mode="valid") for column in padded.T], axis=1)
    return np.concatenate([smooth, smooth[:1]]) if wrap is Wrap.LOOP else smooth

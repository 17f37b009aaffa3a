"""A stand-in for cognition: the oracle's subgoal as numbers, for networks that have no pretrained weights.

A pretrained PONDER and a pretrained POUNCE already share what words and places mean. From scratch they do not, and
each is the other's only teacher. The stand-in cuts that knot: POUNCE first learns to act from it, PONDER first learns
to say the subgoal and to carry it in this form, and then both are trained together, end to end, without it. Nothing
here is learned, so the two first stages need not wait for each other. Serving never sees it.

Layout of one carrier's H numbers, rms 1: sines, cosines and the value itself of both coordinates, the rest a fixed
random code of the text without its coordinates and its colour.
"""

# H hidden size, K carriers

from __future__ import annotations

import functools
import hashlib
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ponderpounce.training.places import PLACE, TEXT_PX

_COLOUR = re.compile(r", which is \w+")
_PERIODS = 2.0 ** np.arange(1, -5, -1)  # of the picture's side: two pictures down to 16 px
NUM_PLACE_FEATURES = 2 * (2 * len(_PERIODS) + 1)
_WAVE_PX = tuple(round(period * TEXT_PX) for period in _PERIODS)
_VALUE_SCALE = 2 * 3**0.5  # a coordinate is uniform in [-1/2, 1/2] at most: rms 1
_MAX_EVEN_WEIGHT = 64.0
_NOWHERE = (TEXT_PX // 2, TEXT_PX // 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubt:
    """How cognition of a PONDER that is not sure differs from a stand-in: it is a mean of two places'.

    Such a mean tells the likelier place by its fast waves, weaker than usual, and a place between the two by the slow
    ones and the coordinates. A POUNCE that has learned from flawless stand-ins alone reads the slow ones.
    """

    share: float = 0.0
    """Of stand-ins that tell a place: how many of them are in doubt."""
    most: float = 0.45
    """Weight of the other place, uniform from 0."""
    away_px: tuple[float, float] = (4.0, 48.0)
    """How far the other place is, the standard deviation of each coordinate in a 256 px picture: log-uniform."""
    noise: float = 0.05
    """Standard deviation of what is added to every number of the place, in doubt or not."""

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"share must be in [0, 1], came {self.share}")
        if not 0 <= self.most < 0.5:
            raise ValueError(f"most must be in [0, 0.5), came {self.most}: at a half either place is as likely")
        if not 0 < self.away_px[0] <= self.away_px[1] or self.noise < 0:
            raise ValueError(f"away_px {self.away_px} must ascend from above 0, noise {self.noise} be at least 0")


NO_DOUBT = Doubt(noise=0.0)


def doubted(subgoal: str, size: int, doubt: Doubt, rng: np.random.Generator) -> NDArray[np.float32]:
    """`stand_in` of a subgoal as a PONDER in doubt would give it, (size,); one without a place is never in doubt."""
    values = stand_in(subgoal, size)
    place = PLACE.search(subgoal)
    if place is None or doubt == NO_DOUBT:
        return values
    values = values.copy()
    numbers = values[:NUM_PLACE_FEATURES]
    if rng.random() < doubt.share:
        yx_px = np.array([int(place[1]), int(place[2])])
        other_px = yx_px + rng.normal(scale=np.exp(rng.uniform(*np.log(doubt.away_px))), size=2)
        weight = rng.uniform(0.0, doubt.most)
        numbers += weight * (place_features((other_px[0], other_px[1])) - numbers)
    numbers += rng.normal(scale=doubt.noise, size=NUM_PLACE_FEATURES).astype(np.float32)
    return values


@functools.lru_cache(maxsize=1 << 16)
def stand_in(subgoal: str, size: int) -> NDArray[np.float32]:
    """Returns the stand-in (size,) for a grounded subgoal, ``<y, x>`` in pixels of a 256 px picture.

    Of several coordinates the first counts; a subgoal without any points at the middle.

    Raises:
        ValueError: ``size`` leaves no room for the text's code.
    """
    num_code = size - NUM_PLACE_FEATURES
    if num_code < NUM_PLACE_FEATURES:
        raise ValueError(f"a stand-in of {size} numbers is too small; expected at least {2 * NUM_PLACE_FEATURES}")
    place = PLACE.search(subgoal)
    yx_px = (int(place[1]), int(place[2])) if place else _NOWHERE
    values = np.concatenate([place_features(yx_px), _code(_COLOUR.sub("", PLACE.sub("<>", subgoal)), num_code)])
    values.flags.writeable = False
    return values


def place_features(yx_px: tuple[float, float]) -> NDArray[np.float32]:
    """A place in a 256 px picture as (NUM_PLACE_FEATURES,) numbers, rms 1."""
    yx = np.array(yx_px, np.float64) / TEXT_PX
    angles = 2 * np.pi * np.outer(1 / _PERIODS, yx).ravel()
    waves = 2**0.5 * np.concatenate([np.sin(angles), np.cos(angles)])
    return np.concatenate([waves, (yx - 0.5) * _VALUE_SCALE]).astype(np.float32)


def even_weights(size: int) -> NDArray[np.float32]:
    """How much each number's squared error should count so that a place counts alike in all that tell it, (size,).

    A place 5 px off changes a wave of 16 px by all that it can change, and the plain coordinate by a fifteenth of its
    spread: left alone, the slow numbers may say another place than the fast ones at next to no loss. What turns once in
    64 px or less counts once, and nothing more than 64 times.
    """
    slopes = 2**0.5 * 2 * np.pi / np.repeat(_WAVE_PX, 2)
    place = np.concatenate([slopes, slopes, np.full(2, _VALUE_SCALE / TEXT_PX)])
    weights = np.ones(size, np.float32)
    weights[:NUM_PLACE_FEATURES] = np.clip((slopes[_WAVE_PX.index(64) * 2] / place) ** 2, 1.0, _MAX_EVEN_WEIGHT)
    return weights


def wave_columns(period_px: int) -> list[int]:
    """Which of `place_features` turn once in so many pixels: sine and cosine of y and x. Raises ValueError if none."""
    first = 2 * _WAVE_PX.index(period_px)
    return [first, first + 1, first + 2 * len(_PERIODS), first + 1 + 2 * len(_PERIODS)]


@functools.lru_cache(maxsize=1 << 10)
def _code(text: str, size: int) -> NDArray[np.float32]:
    """Drawn from the text alone: nearly orthogonal to every other text's."""
    seed = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big")
    return np.random.default_rng(seed).normal(size=size).astype(np.float32)

"""Lengths from outside in a calibration: its terms, and what fits."""

from dataclasses import replace

import numpy as np

from uwsfm.calibration.lengths import Distances, LengthFit, Lengths, PositionFit
from uwsfm.calibration.scaling import (
    alignment,
    require_metres,
    require_right_handed,
    scaled,
    start_scale,
    with_seen_positions,
)
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import LIMIT_CHI2_3, MEDIAN_CHI2_3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.levenberg_marquardt import Term
from uwsfm.solver.state import State
from uwsfm.solver.terms import LengthTerm, PositionTerm, centers

# A scale that nothing determines is held this well, relative: better than refraction
# can measure it, and the force on it remains far above rounding.
HELD_SHARE = 1e-3
LARGEST_STEP = 4.0

# A scale with a larger relative standard deviation is open: that of the start is kept.
OPEN_SCALE, HOPELESS_SCALE = 0.5, 2.0

# Cauchy's c of the positions while outliers are told apart, in standard deviations.
LOSS_SCALE = 3.0

CHI2 = {3: (MEDIAN_CHI2_3, LIMIT_CHI2_3), 1: (0.455, 10.83)}
"""Median and upper thousandth of chi^2, by the coordinates that were measured."""


class Outside:
    """The lengths of one calibration, and what it decides about them."""

    def __init__(self, scene: Scene, lengths: Lengths) -> None:
        """Take what the scene has seen.

        Raises:
            InputError: it does not have it, or too little.
        """
        lengths = with_seen_positions(lengths.checked(scene), scene)
        observed = np.unique(scene.frame_idx)
        known = lengths.positions
        if known is not None:
            self.middle: Array = np.median(known.positions, axis=0)
            self.inliers = np.ones(len(known.positions), dtype=bool)
            self.present = self.inliers
        self.lengths = lengths
        self.one_camera = len(scene.cameras) == 1
        self.hold_scale = self.one_camera and not lengths.give_scale
        self.robust = True
        self.scatter = 1.0
        self.ends = _far_apart(centers(scene.rig_from_world), observed)
        self.held_m = 0.0
        self.nav_start = rigid3.IDENTITY

    @property
    def num_lengths(self) -> int:
        items = (self.lengths.between_points, self.lengths.between_frames)
        given = sum(len(item.ends) for item in items if item is not None)
        return given + int(self.hold_scale)

    @property
    def navigation(self) -> bool:
        return self.lengths.positions is not None

    def start(self, scene: Scene) -> State:
        """The state to begin with: scaled, and placed among the positions."""
        if self.one_camera:
            scene = scaled(scene, start_scale(scene, self.lengths))
        elif self.navigation:
            require_metres(scene, self.lengths)
        return self.placed(scene)

    def placed(self, scene: Scene) -> State:
        """A scene's state, with its scale held and its place among the positions."""
        state = State.from_scene(scene)
        if self.hold_scale:
            first, second = centers(scene.rig_from_world)[self.ends]
            self.held_m = float(np.linalg.norm(first - second))
            if self.held_m == 0.0:
                raise InputError(
                    "one camera whose frames are all at one place: without a motion "
                    "there is no depth"
                )
        if self.navigation:
            found = alignment(scene, self.lengths, with_scale=False).y_from_x
            self.nav_start = np.concatenate([found[:4], found[4:] - self.middle])
            state = replace(state, nav_from_world=self.nav_start)
        return state

    def scale_factor(self, state: State, stddev: float) -> float | None:
        """Newton's step of a scale that is held; None if it is open.

        Refraction goes with the inverse of the scale, and its misfit nearly with the
        square of that.

        Args:
            state: the optimum at this scale.
            stddev: relative, of the scale if it were free.
        """
        if not stddev < HOPELESS_SCALE:
            return None
        first, second = centers(state.rig_from_world[self.ends])
        pull = float(np.linalg.norm(first - second)) / self.held_m - 1.0
        inverse = 1.0 - pull * (stddev / HELD_SHARE) ** 2
        if not stddev < OPEN_SCALE * inverse:
            return None
        return 1.0 / min(inverse, LARGEST_STEP)

    def rescaled(self, state: State, factor: float) -> State:
        """A state larger by a factor, and what is held with it."""
        self.held_m *= factor
        poses = state.rig_from_world.copy()
        poses[:, 4:] *= factor
        return replace(state, rig_from_world=poses, points=factor * state.points)

    @property
    def has_terms(self) -> bool:
        return self.navigation or self.num_lengths > 0

    def terms(
        self, used: IndexArray, frames: IndexArray, sigma_px: float
    ) -> tuple[Term, ...]:
        """What a solve adds to the errors of the images.

        Args:
            used: (P',) index of each point that takes part.
            frames: indices of the frames that take part.
            sigma_px: noise of one image coordinate.
        """
        terms: list[Term] = []
        first = 0
        for item, present, of_frames in (
            (self.lengths.between_points, used, False),
            (self.lengths.between_frames, frames, True),
        ):
            if item is None:
                continue
            _require_ends(item, present, of_frames)
            ends = item.ends if of_frames else np.searchsorted(used, item.ends)
            variances = (item.stddevs_m / sigma_px) ** 2
            terms.append(
                LengthTerm(
                    ends=ends,
                    lengths=item.lengths_m,
                    variances=variances,
                    of_frames=of_frames,
                    first=first,
                )
            )
            first += len(ends)
        if self.hold_scale:
            _require_ends(
                Distances(ends=self.ends[None], lengths_m=_ONE, stddevs_m=_ONE),
                frames,
                True,
            )
            terms.append(
                LengthTerm(
                    ends=self.ends[None],
                    lengths=np.array([self.held_m]),
                    variances=np.array([(HELD_SHARE * self.held_m / sigma_px) ** 2]),
                    of_frames=True,
                    first=first,
                )
            )
        if self.lengths.positions is not None:
            terms.append(self._position_term(frames, sigma_px))
        return tuple(terms)

    def _position_term(self, frames: IndexArray, sigma_px: float) -> PositionTerm:
        known = self.lengths.positions
        assert known is not None
        self.present = np.isin(known.frame_idx, frames)
        keep = self.inliers & self.present
        roots = np.linalg.inv(np.linalg.cholesky(known.covariances[keep]))
        return PositionTerm(
            frames=known.frame_idx[keep],
            positions=known.positions[keep] - self.middle,
            roots=sigma_px / self.scatter * roots,
            lever_arm=known.lever_arm,
            sigma_px=sigma_px,
            loss_scale=LOSS_SCALE if self.robust else None,
            start=self.nav_start,
        )

    def squares(self, state: State) -> Array:
        """(M,) squared misses of what was measured over the given covariances."""
        miss, known = self.misses(state), self.lengths.positions
        assert known is not None
        rows = known.measured
        covariances = known.covariances[:, rows][:, :, rows]
        inverses, miss = np.linalg.inv(covariances), miss[:, rows]
        return np.einsum("ni,nij,nj->n", miss, inverses, miss)

    def misses(self, state: State) -> Array:
        """(M, 3) antenna minus position, metres, in the frame of the positions."""
        known = self.lengths.positions
        assert known is not None
        poses = rigid3.inverse(state.rig_from_world[known.frame_idx])
        antenna = rigid3.transform(poses, known.lever_arm)
        in_nav = rigid3.transform(state.nav_from_world, antenna)
        return in_nav - (known.positions - self.middle)

    def select(self, state: State) -> bool:
        """Choose the positions to believe, and how well; whether that is new.

        Raises:
            InputError: they agree with the images as a mirror image only.
            UwsfmError: fewer than three agree.
        """
        known = self.lengths.positions
        if known is None:
            return False
        if self.robust:
            require_right_handed(
                state.rig_from_world, self.lengths, with_scale=self.one_camera
            )
        before = (self.robust, self.scatter, self.inliers)
        size = int(np.count_nonzero(known.measured))
        median, limit = CHI2[size]
        squares = np.where(self.present, self.squares(state), np.inf)
        middle = float(np.median(squares[self.present]))
        spread = max(1.0, middle / median)
        near = squares <= limit * spread
        # The place in space takes two degrees of freedom per coordinate: heights leave
        # the heading and the horizontal open, and take three.
        taken = 6 if size == 3 else 3
        freedom = max(size * int(np.count_nonzero(near)) - taken, 1)
        variance = float(np.sum(squares[near])) / freedom
        # The given standard deviations are believed until chance cannot explain it.
        chance = 1.0 + 3.0 * np.sqrt(2.0 / freedom)
        self.scatter = float(np.sqrt(variance)) if variance > chance else 1.0
        self.inliers = squares <= limit * self.scatter**2
        self.robust = False
        if np.count_nonzero(self.inliers) < 3:
            raise UwsfmError(
                f"{known.source}: {np.count_nonzero(self.inliers)} of {len(squares)} "
                "positions agree with the images: check their axes, the lever arm and "
                "the frame names"
            )
        return not (
            before[0] is False
            and abs(before[1] - self.scatter) < 0.02 * self.scatter
            and np.array_equal(before[2], self.inliers)
        )

    def length_fit(self, state: State) -> LengthFit | None:
        """How the known lengths came out, with points as the scene numbers them."""
        found: list[Array] = []
        given: list[Distances] = []
        for item, places in (
            (self.lengths.between_points, state.points),
            (self.lengths.between_frames, centers(state.rig_from_world)),
        ):
            if item is not None:
                between = places[item.ends[:, 0]] - places[item.ends[:, 1]]
                found.append(np.linalg.norm(between, axis=1))
                given.append(item)
        if not given:
            return None
        return LengthFit(
            given_m=np.concatenate([item.lengths_m for item in given]),
            stddevs_m=np.concatenate([item.stddevs_m for item in given]),
            found_m=np.concatenate(found),
        )

    def position_fit(self, state: State, covariance: Array) -> PositionFit | None:
        known = self.lengths.positions
        if known is None:
            return None
        return PositionFit(
            frame_idx=known.frame_idx,
            misses_m=self.misses(state) * known.measured,
            inliers=self.inliers,
            scatter=self.scatter,
            covariance=covariance,
            measured=known.measured,
        )

    def entered(self) -> Lengths | None:
        """The lengths as the last solve weighed them; None without any."""
        if not self.lengths.give_scale:
            return None
        known = self.lengths.positions
        if known is not None:
            keep = self.inliers & self.present
            known = replace(
                known,
                frame_idx=known.frame_idx[keep],
                positions=known.positions[keep],
                covariances=self.scatter**2 * known.covariances[keep],
            )
        return replace(self.lengths, positions=known)

    def nav_from_world(self, state: State) -> Array:
        """(7,) the world's place in the frame of the positions."""
        nav = state.nav_from_world
        return np.concatenate([nav[:4], nav[4:] + self.middle])


_ONE: Array = np.ones(1)


def _far_apart(origins: Array, observed: IndexArray) -> IndexArray:
    """Two observed frames (2,) that are far apart."""
    places = origins[observed]
    first = np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1))
    second = np.argmax(np.linalg.norm(places - places[first], axis=1))
    return observed[[first, second]]


def _require_ends(item: Distances, present: IndexArray, of_frames: bool) -> None:
    missing = np.any(~np.isin(item.ends, present), axis=1)
    if np.any(missing):
        row = int(np.argmax(missing))
        what = "the frames" if of_frames else "the ends"
        raise InputError(
            f"{what} of known length {row + 1} ({item.lengths_m[row]:g} m) are not "
            "seen well enough to be placed"
        )

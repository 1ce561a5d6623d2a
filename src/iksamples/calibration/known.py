"""What is known of an arm: its drawing, how far it may be off that, what samples leave of it."""

from dataclasses import dataclass, field, replace

import numpy as np

from iksamples.arm.chain import Floats, SerialChain
from iksamples.arm.real import deviated
from iksamples.errors import IksamplesError


SMALLEST_NOISE_MM = 1e-6
"""Noise below this [mm, or mrad for turns] is rounding; it would spoil the solver's condition."""
FEWEST_FREEDOM = 3.0
"""Measured numbers beyond those that the fit takes up, below which they do not tell the noise."""
UNLIKELY_NOISE = 1e-3
"""Chance of residuals below which a given noise is not believed."""
UNLIKELY_ARM = 0.05
"""Chance of deviations below which the prior is widened."""
NOISE_MM, NOISE_RAD = 0.1, 0.001
"""How well a tool is measured where nobody says better: a coordinate, a turn's component."""


@dataclass(frozen=True)
class Prior:
    """How far an arm may be from its drawing: standard deviations of every component of a row.

    Attributes:
        displacement_mm: Of the displacements of joints and tool [mm].
        rotation_rad: Of their rotation vectors [rad].
        tool_mm: Of the tool's displacement, where that is less certain [mm]; None: like the others.
    """

    displacement_mm: float = 1.0
    rotation_rad: float = float(np.radians(1.0))
    tool_mm: float | None = None

    def __post_init__(self) -> None:
        """Refuses what is no standard deviation."""
        own = (self.displacement_mm, self.rotation_rad, self.tool_mm or self.displacement_mm)
        if not (np.isfinite(own).all() and min(own) > 0):
            raise IksamplesError(
                f"The prior ({self.displacement_mm:g} mm, {self.rotation_rad:g} rad): how far the "
                "arm may be from its drawing has to be above zero."
            )

    def deviations(self, n_joints: int) -> Floats:
        """Standard deviations of the deviations [mm and rad], shape (joints + 1, 6)."""
        rows = np.full((n_joints + 1, 6), self.displacement_mm, float)
        rows[:, 3:] = self.rotation_rad
        if self.tool_mm:
            rows[-1, :3] = self.tool_mm
        return rows


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fitted drawing.

    Attributes:
        drawing: What was fitted.
        deviations: The most probable deviations [mm and rad], shape (joints + 1, 6).
        root: A square root of the posterior's covariance: deviations are
            ``deviations + root @ z`` with z standard normal, shape (6 (joints + 1),) * 2.
        noise_mm: Standard deviation of a measured coordinate, given or estimated [mm].
        freedom: Measured coordinates less what the fit takes up of them: the degrees of freedom of
            the residuals, and of the noise where it is estimated.
        residuals_mm: Where the fitted arm has the tool, less where it was measured [mm], shape
            (poses, 3); NaN where nothing was measured.
        centres_mm: The points in which the tool was held [mm], shape (groups, 3); empty where the
            positions were measured.
        noise_estimated: Whether the noise is what the residuals show.
    """

    drawing: SerialChain
    deviations: Floats
    root: Floats
    noise_mm: float
    freedom: float
    residuals_mm: Floats
    centres_mm: Floats = field(default_factory=lambda: np.empty((0, 3)))
    noise_estimated: bool = False

    @classmethod
    def unmeasured(cls, drawing: SerialChain, prior: Prior, noise_mm: float | None) -> "Fitted":
        """What is known before anything is measured: the drawing and its prior."""
        sd, none = prior.deviations(drawing.n_joints), np.empty((0, 3))
        unknown = noise_mm is None
        noise = NOISE_MM if noise_mm is None else noise_mm
        return cls(drawing, 0 * sd, np.diag(sd.ravel()), noise, 0, none, noise_estimated=unknown)

    @property
    def chain(self) -> SerialChain:
        """The fitted arm."""
        return deviated(self.drawing, self.deviations)

    @property
    def noise_is_plausible(self) -> bool:
        """Whether residuals as large as these are no rarer than one in a thousand."""
        from scipy.stats import chi2

        if self.freedom < FEWEST_FREEDOM:
            return True
        squares = float(np.nansum(self.residuals_mm**2)) / self.noise_mm**2
        return bool(chi2.sf(squares, self.freedom) > UNLIKELY_NOISE)

    @property
    def covariance(self) -> Floats:
        """Covariance of the deviations, row after row [mm and rad], shape (parameters,) * 2."""
        return self.root @ self.root.T

    def draws(self, n: int, generator: np.random.Generator) -> Floats:
        """Deviations that may be the arm's, drawn from the posterior, shape (n, joints + 1, 6).

        Where the noise is estimated, Student's t with the residuals' degrees of freedom: noise may
        be more than it seems.
        """
        normal = generator.standard_normal((n, len(self.root)))
        if self.noise_estimated:
            normal *= np.sqrt(self.freedom / generator.chisquare(self.freedom, (n, 1)))
        return self.deviations + (normal @ self.root.T).reshape(n, *self.deviations.shape)

    def expecting(self, informs: Floats) -> "Fitted":
        """What will be known once some poses are recorded too, whatever is measured there.

        Args:
            informs: ``worst.Measured.informs`` of these poses, shape (poses, rows, parameters).
        """
        rows = informs.reshape(-1, len(self.root)) @ self.root
        _, values, right = np.linalg.svd(rows)
        seen = np.zeros(len(right))
        seen[: len(values)] = values**2
        return replace(
            self,
            root=self.root @ right.T / np.sqrt(1 + seen),
            freedom=self.freedom + len(rows) - float(np.sum(seen / (1 + seen))),
        )

"""Runs: trained or carved models in their folders."""

from __future__ import annotations

import base64
import html
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Sequence

from . import _plenoxel
from ._plenoxel import Camera, Grid, Mesh, Picture, PointCloud, Scene

if TYPE_CHECKING:
    import os

    import numpy as np

#: Largest report that is put into a notebook, in bytes. Larger ones are linked.
LARGEST_INLINE = 40_000_000


@dataclass(frozen=True)
class Scores:
    """Scores of the views of a split. Rendered images are clamped to [0, 1] and not rounded."""

    #: Mean PSNR in dB.
    psnr: float
    #: Mean SSIM; None for images smaller than 11 pixels per side.
    ssim: float | None
    #: Scores of each view: name, psnr, mse, ssim, ssim_same.
    per_view: list[dict[str, Any]] = field(repr=False)
    #: All figures with their definitions, as in the JSON object of ``plenoxel evaluate``.
    figures: dict[str, Any] = field(repr=False)


def scores_of(text: str) -> Scores:
    """Return the scores in a text of JSON."""
    figures = json.loads(text)
    per_view = figures.pop("per_view")
    return Scores(psnr=figures["psnr"], ssim=figures["ssim"], per_view=per_view, figures=figures)


class Run:
    """A run in its folder. The model is read when it is needed first.

    In a notebook, a run shows its report.
    """

    def __init__(self, inner: Any, scene: Scene | None = None):
        self._inner = inner
        self._scene = scene

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return self._inner.folder

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return self._inner.scene

    @property
    def model(self) -> str:
        """Kind of the model, such as "plenoxels" or "tensorf"."""
        return self._inner.model

    @property
    def config(self) -> str:
        """The settings: the text of config.toml. ``train(scene, config=...)`` repeats the run from a file with this text."""
        return self._inner.config

    @property
    def figures(self) -> dict[str, Any]:
        """The final figures of the run: result.json. Empty before the run has ended."""
        text = self._inner.figures()
        return {} if text is None else json.loads(text)

    @property
    def psnr(self) -> float | None:
        """Mean PSNR of the test views in dB; None if they were not evaluated."""
        return self.figures.get("psnr")

    @property
    def ssim(self) -> float | None:
        """Mean SSIM of the test views; None if they were not evaluated."""
        return self.figures.get("ssim")

    def metrics(self) -> list[dict[str, Any]]:
        """Return the metrics of training: loss, psnr, seconds and more of each recorded step."""
        lines = (json.loads(line) for line in self._inner.metrics().splitlines() if line.strip())
        return [line for line in lines if "step" in line]

    def render(self, camera: Camera, *, background: Sequence[float] | None = None) -> Picture:
        """Render the image of a camera over a background, sRGB in [0, 1]; the default is that of the training."""
        return self._inner.render(camera, None if background is None else list(background))

    def evaluate(self, split: str = "test", *, downscale: int | None = None, background: Sequence[float] | None = None) -> Scores:
        """Compare the model with the photographs of a split.

        Raises:
            SettingsError: The scene has no such views; or they were arrays of another process: give the scene to `load`.
        """
        return scores_of(self._inner.evaluate(split, downscale, None if background is None else list(background)))

    def parameters(self) -> dict[str, np.ndarray]:
        """Return the parameters of the model by name, as read-only arrays without a copy."""
        return self._inner.parameters()

    def grid(self) -> Grid:
        """Return the tables of the voxel grid.

        Raises:
            InputError: The model has no voxels.
        """
        return self._inner.grid()

    def points(
        self,
        *,
        min_alpha: float | None = None,
        min_weight: float | None = None,
        min_object: float | None = None,
        color: str = "seen",
        sor_sigma: float | None = None,
        sor_neighbours: int = 6,
    ) -> PointCloud:
        """Return the voxels as a point cloud.

        Args:
            min_alpha: Smallest opacity of a voxel from face to face.
            min_weight: Smallest of the largest rendering weight of a voxel in the training views.
            min_object: Smallest share of a voxel's pixels that show the object; fog in the color of the background has 0.
            color: "seen", the mean color in the training views, which are rendered for it; or "mean", the mean over all directions, which needs no views;
                ``min_weight`` and ``min_object`` then have no effect.
            sor_sigma: Remove statistical outliers: points whose mean distance to their neighbours is above the mean by more than this number of standard
                deviations. None removes none.
            sor_neighbours: Number of nearest points, including the point itself.
        """
        if color not in ("seen", "mean"):
            from ._errors import SettingsError

            raise SettingsError(f'color: invalid value "{color}"; expected "seen" or "mean"')
        return self._inner.points(min_alpha, min_weight, min_object, color == "seen", sor_sigma, sor_neighbours)

    def mesh(
        self,
        *,
        level: float | None = None,
        min_part: int = 100,
        smooth: int = 0,
        max_triangles: int | None = None,
        direction: Sequence[float] | None = None,
    ) -> Mesh:
        """Return the surface on which the density has a level.

        Args:
            level: Density, 1 / length; the default is that at which a voxel has an alpha of 0.3.
            min_part: Parts of fewer triangles are removed, except the largest part.
            smooth: Number of smoothing passes.
            max_triangles: Decimate to this number of triangles.
            direction: View direction of the colors; the default is against the normals.
        """
        return self._inner.mesh(level, min_part, smooth, max_triangles, None if direction is None else list(direction))

    def write_report(self) -> Path:
        """Write report.html again, with curves, pictures and an interactive viewer, and return its path."""
        _plenoxel.write_report(self.folder, self._scene)
        return self._inner.report

    def _repr_html_(self) -> str:
        page = Path(self._inner.report)
        title = html.escape(repr(self))
        if not page.exists():
            return f"<p>{title}; <code>write_report()</code> makes its page</p>"
        link = f'<a href="{html.escape(page.resolve().as_uri())}" target="_blank">{title}</a>'
        if page.stat().st_size > LARGEST_INLINE:
            return f"<p>{link}</p>"
        # A data URL, because the page has scripts and quotes of its own.
        content = base64.b64encode(page.read_bytes()).decode("ascii")
        frame = f'<iframe src="data:text/html;base64,{content}" width="100%" height="720" style="border: 1px solid #ccc"></iframe>'
        return f"<p>{link}</p>{frame}"

    def __repr__(self) -> str:
        psnr = self.psnr
        score = "" if psnr is None else f", {psnr:.2f} dB"
        return f"Run({self.folder}, {self.model} of {self.scene}{score})"


def load(folder: str | os.PathLike[str], scene: Scene | None = None, *, best: bool = False) -> Run:
    """Open the folder of a run that this package or the program ``plenoxel`` has written.

    Args:
        folder: The folder.
        scene: The views, if they have moved or were arrays.
        best: Use the checkpoint with the best validation PSNR instead of the last.

    Raises:
        InputError: This is not a run folder, or it has no such checkpoint.
    """
    return Run(_plenoxel.load(folder, scene, best), scene)

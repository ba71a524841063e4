"""Training and carving."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Callable, Mapping, NamedTuple, Sequence, Union

from . import _plenoxel
from ._errors import DtypeError, Interrupted
from ._plenoxel import Param, Scene, Step, Tensor
from ._run import Run, load

if TYPE_CHECKING:
    import os

Loss = Callable[[Step], Tensor]
#: A loss, a weight and a loss, or several of them by name.
Losses = Union[Loss, "tuple[float, Loss]", Mapping[str, "Loss | tuple[float, Loss]"]]


class Preset(NamedTuple):
    """A preset: its name, its purpose, and its training time on two cores."""

    name: str
    purpose: str
    time: str


def presets() -> list[Preset]:
    """Return the presets."""
    return [Preset(*preset) for preset in _plenoxel.presets()]


def train(
    scene: Scene,
    preset: str | None = None,
    *,
    time: float | str | None = None,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    loss: Losses | None = None,
    params: Sequence[Param] = (),
    config: str | os.PathLike[str] | None = None,
    callback: Callable[[dict[str, Any]], Any] | None = None,
    progress: bool = True,
    page: bool = True,
    checkpoint_every: float | str = "5m",
    test_views: int | None = None,
    threads: int | None = None,
    **settings: Any,
) -> Run:
    """Train a model of a scene, evaluate it on the test views, and return the run.

    Ctrl-C saves the training and raises `Interrupted`; an exception of the callback also saves it. Other threads of Python go on while it trains.

    Args:
        scene: The views.
        preset: Name of a preset; see `presets`. The default is "fast", or none if `config` is a complete file.
        time: Plan the training for a duration on this machine, such as 90, "60s" or "5m". The default is the number of steps of the settings.
        out: Folder of the run. The default is ``runs/<scene>-<n>`` with the first free n.
        force: Overwrite a run in the folder.
        loss: A function from a `Step` to a scalar `Tensor`, a pair of a weight and a function, or several by name. They are added to the losses of the
            settings; ``losses={"mse": None}`` removes the loss ``mse``.
        params: Parameters that the losses read with ``step.param(name)``.
        config: A file of settings, such as the config.toml of a run.
        callback: Called with each event, a dict with its ``kind``: note, loading, started, planned, step, stage_ended, saved or evaluating.
        progress: Show a bar, if tqdm is installed.
        page: Write pictures and report.html.
        checkpoint_every: Checkpoint interval, seconds or such as "5m".
        test_views: Largest number of test views for the final scores; 0 for no evaluation.
        threads: Number of threads; results do not depend on it. The default is one per core.
        **settings: Settings by their keys in config.toml, such as ``rays_per_step=4096``, ``capture={"space": "box"}`` or ``**{"stages[0].resolution": 64}``.
            None removes a key.

    Raises:
        SettingsError: A setting is unknown or invalid; the folder is not empty.
        InputError: Images cannot be read.
        NumericError: The loss or the model is not finite.
        Any exception of a loss.
    """
    ended = with_bar(
        progress,
        callback,
        lambda listener: _plenoxel.train(
            scene, preset, config, settings, time, out, force, extras(loss, params, listener, checkpoint_every, test_views, page, threads)
        ),
    )
    return _run(ended, scene)


def resume(
    run: Run | str | os.PathLike[str],
    scene: Scene | None = None,
    *,
    loss: Losses | None = None,
    params: Sequence[Param] = (),
    callback: Callable[[dict[str, Any]], Any] | None = None,
    progress: bool = True,
    page: bool = True,
    checkpoint_every: float | str = "5m",
    test_views: int | None = None,
    threads: int | None = None,
) -> Run:
    """Resume a run that was interrupted, with the same losses. The result has the same bits as that of a run without an interruption.

    Args:
        run: The run, or its folder.
        scene: The views, if they have moved or were arrays.

    The other arguments are those of `train`.
    """
    folder = run.folder if isinstance(run, Run) else run
    ended = with_bar(
        progress,
        callback,
        lambda listener: _plenoxel.resume(folder, scene, extras(loss, params, listener, checkpoint_every, test_views, page, threads)),
    )
    return _run(ended, scene)


def carve(
    scene: Scene,
    *,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    callback: Callable[[dict[str, Any]], Any] | None = None,
    **settings: Any,
) -> Run:
    """Carve an opaque colored grid from the silhouettes of images with alpha, without training.

    Args:
        scene: The views.
        out: Folder of the run. The default is ``runs/<scene>-<n>`` with the first free n.
        force: Overwrite a run in the folder.
        callback: Called with each event, a dict with the ``kind`` note and its text.
        **settings: Settings by their keys in config.toml, such as ``carve={"resolution": 128, "rule": "rays"}``.

    Raises:
        SettingsError: A setting is unknown or invalid; no silhouettes; the folder is not empty.
    """
    return load(_plenoxel.carve(scene, settings, out, force, callback), scene)


def _run(ended: Any, scene: Scene | None) -> Run:
    if not ended.finished:
        raise Interrupted(ended.folder, ended.steps, ended.total)
    return load(ended.folder, scene)


def extras(loss, params, listener, checkpoint_every, test_views, page, threads) -> dict[str, Any]:
    return {
        "losses": _losses(loss),
        "params": list(params),
        "listener": listener,
        "checkpoint_every": checkpoint_every,
        "test_views": test_views,
        "page": page,
        "threads": threads,
    }


def _losses(loss: Losses | None) -> list[tuple[str, float, Loss]]:
    """Return losses as name, weight and function."""
    if loss is None:
        return []
    named = loss if isinstance(loss, Mapping) else {_name(loss): loss}
    return [(str(name), *_weighted(name, one)) for name, one in named.items()]


def _weighted(name: str, loss: Any) -> tuple[float, Loss]:
    weight, function = loss if isinstance(loss, tuple) and len(loss) == 2 else (1.0, loss)
    if not callable(function):
        raise DtypeError(f"loss {name}: this is a {type(function).__name__}; expected a function of the step, or a weight and a function")
    if isinstance(weight, bool) or not isinstance(weight, (int, float)):
        raise DtypeError(f"loss {name}: the weight is a {type(weight).__name__}; expected a number")
    return float(weight), function


def _name(loss: Any) -> str:
    function = loss[1] if isinstance(loss, tuple) and len(loss) == 2 else loss
    name = getattr(function, "__name__", "loss")
    return "loss" if name == "<lambda>" else name


def with_bar(progress: bool, callback: Callable[[dict[str, Any]], Any] | None, run: Callable[[Any], Any]) -> Any:
    """Call `run` with a listener for a bar and a callback."""
    bar = _bar() if progress else None
    if bar is None:
        return run(callback)

    def listener(event: dict[str, Any]) -> None:
        if event["kind"] in ("started", "planned"):
            bar.total = event["steps"]
            bar.refresh()
        elif event["kind"] == "step":
            bar.update(event["step"] + 1 - bar.n)
            bar.set_postfix_str(f"{event['psnr']:.2f} dB", refresh=False)
        if callback is not None:
            callback(event)

    with bar:
        return run(listener)


def _bar() -> Any:
    try:
        from tqdm.auto import tqdm  # type: ignore[import-untyped, unused-ignore]
    except ImportError:
        return None
    return tqdm(total=None, unit="step", desc="training")

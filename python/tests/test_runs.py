"""Training, and what a run shows."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import plenoxel as px


def test_a_run_has_scores_that_evaluation_repeats_to_the_bit(run):
    scores = run.evaluate()
    assert scores.psnr == run.psnr and scores.ssim == run.ssim
    assert [view["psnr"] for view in scores.per_view] == [view["psnr"] for view in run.figures["per_view"]]
    assert run.model == "plenoxels" and run.scene == "procedural" and "[losses]" in run.config
    assert run.metrics()[-1]["step"] == 29


def test_a_run_equals_that_of_the_program_to_the_bit(scene, run, small, tmp_path):
    (tmp_path / "config.toml").write_text(run.config)
    line = ["train", "--config", "config.toml", "--out", "run", "--scene-size", "24x24", "--scene-views", "12,2,2", "--no-report"]
    subprocess.run([sys.executable, "-m", "plenoxel", *line], cwd=tmp_path, check=True, capture_output=True)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["psnr"] == run.psnr
    same = px.load(tmp_path / "run")
    for name, values in run.parameters().items():
        assert np.array_equal(values, same.parameters()[name])


def test_arrays_train_like_the_scene_they_were_taken_from(scene, arrays, run, small, tmp_path):
    splits = ["train"] * 12
    same = px.train(px.dataset(**arrays, splits=splits), out=tmp_path / "run", test_views=0, **small)
    assert np.array_equal(run.parameters()["density"], same.parameters()["density"])
    # OpenCV axes, channels in float, and a copy with other strides.
    turned = arrays["camera_to_world"] * np.array([1.0, -1.0, -1.0, 1.0])
    images = np.asfortranarray(arrays["images"] / 255.0)
    other = px.dataset(images, arrays["intrinsics"], turned, splits=splits, axes="opencv")
    assert other.cameras("train") == px.dataset(**arrays, splits=splits).cameras("train")
    assert np.array_equal(other.images("train")[3], arrays["images"][3])
    with pytest.raises(px.SettingsError, match="in the memory of the program that trained it"):
        px.load(same.folder).evaluate("train")
    assert px.load(same.folder, other).evaluate("train").psnr > 5


def test_settings_are_those_of_config_toml(scene, small, tmp_path):
    keys = {key: value for key, value in small.items() if key != "stages"}
    losses = {"mse": None, "charbonnier": 2}
    run = px.train(scene, "voxels", out=tmp_path / "run", **keys, losses=losses, **{"stages[*].steps": 3, "stages[0].resolution": 8}, threads=1)
    assert "charbonnier = 2" in run.config and "mse" not in run.config and "resolution = 8" in run.config
    again = px.train(scene, config=run.folder / "config.toml", out=tmp_path / "again", page=False, progress=False)
    assert again.psnr == run.psnr


def test_events_are_told_in_order_and_the_bar_follows(scene, small, tmp_path):
    events = []
    px.train(scene, out=tmp_path / "run", **{**small, "progress": True}, callback=events.append)
    kinds = [event["kind"] for event in events]
    assert kinds.count("step") == 30 and kinds.index("started") < kinds.index("step") < kinds.index("evaluating")
    steps = [event for event in events if event["kind"] == "step"]
    assert [event["step"] for event in steps] == list(range(30))
    assert steps[-1]["loss"] < steps[0]["loss"] and set(steps[0]["losses"]) >= {"mse"}


def test_an_exception_of_a_callback_saves_the_run_and_is_raised(scene, small, run, tmp_path):
    def callback(event):
        if event["kind"] == "step" and event["step"] == 3:
            raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        px.train(scene, out=tmp_path / "run", **small, callback=callback)
    done = px.resume(tmp_path / "run", page=False, progress=False)
    assert np.array_equal(run.parameters()["color"], done.parameters()["color"])


@pytest.mark.skipif(os.name == "nt", reason="signals are sent as on Unix")
def test_an_interruption_saves_the_run(scene, small, run, tmp_path):
    signalled = threading.Event()

    def callback(event):
        if event["kind"] == "step" and event["step"] == 3:
            signalled.set()
            os.kill(os.getpid(), signal.SIGINT)

    def waiting(step):
        # Steps are faster than signals.
        if step.number == 10:
            signalled.wait()
            time.sleep(0.5)
        return 0.0 * step.rgb.sum()

    # A program that a shell has started in the background ignores the signal.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(px.Interrupted, match="resume with plenoxel.resume") as interrupted:
            px.train(scene, out=tmp_path / "run", **small, callback=callback, loss=waiting)
    finally:
        signal.signal(signal.SIGINT, former)
    assert 4 <= interrupted.value.steps <= 11
    assert isinstance(interrupted.value, KeyboardInterrupt) and interrupted.value.total == 30
    done = px.resume(interrupted.value.folder, page=False, progress=False)
    assert done.psnr == run.psnr


def test_pictures_have_the_colors_of_the_views_and_their_depth(scene, run):
    camera = scene.cameras("test")[0]
    picture = run.render(camera)
    image = scene.images("test")[0].astype(np.float32) / 255
    target = image[..., :3] * image[..., 3:] + 1 - image[..., 3:]
    assert px.psnr(picture.rgb, target) == pytest.approx(run.figures["per_view"][0]["psnr"], abs=1e-3)
    assert picture.rgb.shape == (24, 24, 3) and picture.depth.shape == picture.opacity.shape == (24, 24)
    assert np.nanmin(picture.depth) > 1 and np.asarray(picture).shape == (24, 24, 3)
    assert picture._repr_png_().startswith(b"\x89PNG")
    black = run.render(camera.resized(12, 12), background=(0, 0, 0))
    assert black.rgb.mean() < picture.rgb.mean()
    assert run.render(px.Camera.look_at((3, 2, 1), width=8, height=6)).rgb.shape == (6, 8, 3)


def test_tables_are_read_only_views(run):
    grid = run.grid()
    density = grid.density
    assert density.base is not None and not density.flags.writeable and not density.flags.owndata
    assert density.__array_interface__["data"][0] == run.grid().density.__array_interface__["data"][0]
    with pytest.raises(ValueError, match="read-only"):
        density[0] = 1
    assert set(run.parameters()) >= {"density", "color"}
    voxels = grid.voxels()
    assert voxels.shape == (len(density), 3) and voxels.max() == grid.resolution - 1
    assert grid.voxel_side == pytest.approx(2 * grid.half_width / grid.resolution)


def test_points_and_meshes_are_in_the_coordinates_of_the_dataset(run, tmp_path):
    cloud = run.points(min_alpha=0.1)
    assert len(cloud) > 10 and np.abs(cloud.positions).max() < 1.6 and cloud.colors.dtype == np.uint8
    assert {"opacity", "density", "weight", "object"} <= set(cloud.fields)
    assert len(run.points(min_alpha=0.1, sor_sigma=1.0)) < len(cloud) <= len(run.points(min_alpha=0.1, color="mean"))
    cloud.save(tmp_path / "cloud.ply")
    mesh = run.mesh(level=1.0, min_part=0)
    assert mesh.triangles.max() == len(mesh.positions) - 1 and mesh.volume > 0
    for ending in ("ply", "obj", "glb", "stl"):
        mesh.save(tmp_path / f"mesh.{ending}")


def test_a_capture_keeps_its_own_coordinates(arrays, small, tmp_path):
    moved = arrays["camera_to_world"].copy()
    moved[:, :3, 3] = 100 + 10 * moved[:, :3, 3]
    scene = px.dataset(arrays["images"], arrays["intrinsics"], moved, normalize=True)
    assert scene.cameras("train")[2].camera_to_world == pytest.approx(moved[3])
    settings = {**small, "capture": {"space": "box", "orient": "none"}, "half_width": 1.0}
    run = px.train(scene, out=tmp_path / "run", **settings)
    cloud = run.points(min_alpha=0.01, min_weight=0, min_object=0)
    assert np.abs(cloud.positions.mean(axis=0) - 100).max() < 20
    assert np.nanmedian(run.render(scene.cameras("test")[0]).depth) > 10


def test_a_notebook_shows_the_page(scene, small, tmp_path):
    run = px.train(scene, out=tmp_path / "run", **{**small, "page": True})
    page = run._repr_html_()
    assert "iframe" in page and "report.html" in page and (run.folder / "images").is_dir()
    (run.folder / "report.html").unlink()
    assert "write_report" in run._repr_html_()
    assert run.write_report().exists()


def test_carving_makes_a_run(scene, tmp_path):
    notes = []
    run = px.carve(scene, out=tmp_path / "run", carve={"resolution": 32, "rule": "rays"}, callback=notes.append)
    assert run.grid().resolution == 32 and any("carved 32" in event["text"] for event in notes)
    assert run.evaluate().psnr > 12


def test_two_threads_train_at_once(scene, small, run, tmp_path):
    found = {}

    def work(name):
        found[name] = px.train(scene, out=tmp_path / name, **small, loss=lambda step: 0.0 * step.rgb.sum())

    threads = [threading.Thread(target=work, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert found["a"].psnr == found["b"].psnr == pytest.approx(run.psnr, abs=0.01)


SPAWNED = """
import multiprocessing, sys
import plenoxel as px

def score(out):
    scene = px.procedural(size=16, train=4, val=0, test=1)
    return px.Tensor([1.0, 2.0]).sum().item()

if __name__ == "__main__":
    px.Tensor([1.0]).exp()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        print(pool.map(score, ["a"]))
    if "fork" in multiprocessing.get_all_start_methods():
        with multiprocessing.get_context("fork").Pool(1) as pool:
            try:
                pool.map(score, ["b"])
            except px.StateError as error:
                print(error)
"""


def test_processes_are_spawned_and_a_fork_is_refused(tmp_path):
    (tmp_path / "spawned.py").write_text(SPAWNED)
    done = subprocess.run([sys.executable, "spawned.py"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert lines[0] == "[3.0]", done.stderr
    if len(lines) > 1:
        assert "forked" in lines[1] and "spawn" in lines[1]

"""Exported datasets agree with the traffic, and the README with the files."""

import csv
import json
import re

import numpy as np
import pytest

from egvs import load, write_clouds
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core import files
from egvs.core.errors import InputError
from egvs.extensions.validation import dataset, held_out_traffic, kitti
from egvs.extensions.validation.dataset import write_dataset
from egvs.extensions.validation.dataset_files import LAYOUTS
from egvs.formats.point_clouds import read_points
from egvs.sensors.sensor import rotation_world_sensor

SITES = """\
site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg
level,10,8,3,0,0,0
tilted,30.5,-9,4,110,-12,0
rolled,20,8,5,-75,-20,15
behind,16,6.5,6.2,0,85,0
"""
FRAMES = 10
QUIET = "sensors.small.range_sigma_m=0"


@pytest.fixture
def four_sites(mini):
    """The small scenario with level, tilted and rolled sensors, and one on a roof that points at the sky."""
    (mini / "sites.csv").write_text(SITES)
    return mini


def truth(scenario, tmp_path):
    """The record, its frames, and for each site the clouds of a new simulator."""
    record = held_out_traffic.prepare_held_out_traffic(scenario, tmp_path / "truth", FRAMES)
    frames = list(record.read())
    clouds = {}
    for site in record.scene.sites:
        simulator = CloudSimulator.of_site(record.scene, site)
        clouds[site.name] = [simulator.sweep(f, sweep_rng(record.scenario.seed, site.name, f.number)) for f in frames]
    return record, frames, clouds


def in_world(pose, points):
    """Convert points of a level frame to the world frame in two steps: yaw, then translation."""
    return points @ rotation_world_sensor(pose.yaw_deg, 0, 0).T + np.asarray(pose.position_m)


def labels_of(folder, kind, name):
    """Classes and boxes of a frame, as a detector's program reads them."""
    if kind == "kitti":
        labels = kitti.read_labels(folder / "label_2" / f"{name}.txt")
        return list(labels.names), labels.boxes
    rows = [line.split(" ") for line in (folder / "labels" / f"{name}.txt").read_text().splitlines()]
    return [row[-1] for row in rows], np.array([row[:-1] for row in rows], dtype=float).reshape(-1, 7)


def points_of(folder, kind, name):
    """Points of a frame, (n, 3)."""
    if kind == "kitti":
        return np.fromfile(folder / "velodyne" / f"{name}.bin", dtype="<f4").reshape(-1, 4)[:, :3]
    if kind == "openpcdet":
        points = np.load(folder / "points" / f"{name}.npy")
        assert points.dtype == np.float32 and points.shape[1] == 4
        return points[:, :3]
    return read_points(folder / "points" / f"{name}.{kind}", "")[0]


def inside(points, box, slack_m):
    """Which points are in an upright box."""
    along = points - box[:3]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    local = np.column_stack([along[:, 0] * cos + along[:, 1] * sin, along[:, 1] * cos - along[:, 0] * sin, along[:, 2]])
    return (np.abs(local) <= box[3:6] / 2 + slack_m).all(axis=1)


@pytest.mark.parametrize("kind", ["kitti", "openpcdet"])
def test_labels_and_points_equal_traffic(four_sites, tmp_path, kind):
    """Boxes to 1e-3 m and 1e-3 rad in the world; each cloud has its points, and those on a vehicle are in its box."""
    scenario = load(four_sites, [QUIET])
    record, frames, clouds = truth(scenario, tmp_path)
    done = write_dataset(scenario, tmp_path / "out", frames=FRAMES, kind=kind)
    checked = 0
    for site in record.scene.sites:
        folder = tmp_path / "out" / site.name
        for frame, cloud in zip(frames, clouds[site.name], strict=True):
            name = f"{frame.number:06d}"
            classes, boxes = labels_of(folder, kind, name)
            labelled = np.flatnonzero(cloud.points_on(len(frame.boxes)))
            assert classes == ["Car"] * len(labelled)
            np.testing.assert_allclose(in_world(site.pose, boxes[:, :3]), frame.boxes[labelled, :3], atol=1e-3)
            np.testing.assert_allclose(boxes[:, 3:6], frame.boxes[labelled, 3:6], atol=1e-3)
            turned = boxes[:, 6] + np.radians(site.pose.yaw_deg) - frame.boxes[labelled, 6]
            np.testing.assert_allclose(np.abs(np.exp(1j * turned) - 1), 0, atol=1e-3)
            points = points_of(folder, kind, name)
            beams = rotation_world_sensor(*site.pose.angles_deg) @ cloud.sweep.points[:, :3].T.astype(float)
            np.testing.assert_allclose(in_world(site.pose, points) - site.pose.position_m, beams.T, atol=1e-4)
            for row, box in zip(labelled, boxes, strict=True):
                assert inside(points[cloud.owner == row], box, 1e-3).all()
                checked += 1
    assert checked == sum(summary.labelled for summary in done.sites) > 20


def test_every_frame_is_in_one_split_list(four_sites, tmp_path):
    done = write_dataset(load(four_sites), tmp_path / "out", frames=FRAMES, kind="openpcdet")
    for summary in done.sites:
        sets = {
            s: (tmp_path / "out" / summary.site / "ImageSets" / f"{s}.txt").read_text().split()
            for s in ("train", "val", "empty")
        }
        names = [path.stem for path in (tmp_path / "out" / summary.site / "points").iterdir()]
        assert sorted([*sets["train"], *sets["val"], *sets["empty"]]) == sorted(names) and len(names) == FRAMES
        assert max(sets["train"], default="") < min(sets["val"], default="9")
        with_labels = {p.stem for p in (tmp_path / "out" / summary.site / "labels").iterdir() if p.read_text()}
        assert with_labels == {*sets["train"], *sets["val"]}
    by_name = {summary.site: summary for summary in done.sites}
    assert (len(by_name["level"].train), len(by_name["level"].val)) == (8, 2)
    assert len(by_name["behind"].empty) == FRAMES and not by_name["behind"].labelled


@pytest.mark.parametrize("kind", ["ply", "pcd"])
def test_points_have_their_object(four_sites, tmp_path, kind):
    scenario = load(four_sites)
    _, frames, clouds = truth(scenario, tmp_path)
    write_dataset(scenario, tmp_path / "out", sites=["rolled"], frames=FRAMES, kind=kind)
    record = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")] + [("object", "<i4")])
    for frame, cloud in zip(frames, clouds["rolled"], strict=True):
        path = tmp_path / "out" / "rolled" / "points" / f"{frame.number:06d}.{kind}"
        data = np.frombuffer(path.read_bytes()[-len(cloud.owner) * record.itemsize :], dtype=record)
        np.testing.assert_array_equal(data["object"], cloud.owner)
        np.testing.assert_array_equal(data["intensity"], cloud.sweep.points[:, 3])
        np.testing.assert_array_equal(points_of(tmp_path / "out" / "rolled", kind, path.stem)[:, 0], data["x"])


def test_objects_csv_has_all_boxes_and_marks_ground_truth(four_sites, tmp_path):
    scenario = load(four_sites)
    record, frames, clouds = truth(scenario, tmp_path)
    write_dataset(scenario, tmp_path / "out", sites=["behind", "level"], frames=FRAMES, kind="pcd")
    for site in ("behind", "level"):
        rows = list(csv.DictReader((tmp_path / "out" / site / "objects.csv").read_text().splitlines()))
        assert len(rows) == sum(len(frame.boxes) for frame in frames)
        at = iter(rows)
        for frame, cloud in zip(frames, clouds[site], strict=True):
            targets, on = set(frame.target_rows(record.scene.roi).tolist()), cloud.points_on(len(frame.boxes))
            for number in range(len(frame.boxes)):
                row = next(at)
                assert (row["frame"], row["object"]) == (f"{frame.number:06d}", str(number))
                assert (row["vehicle"], row["kind"], row["class"]) == (frame.vehicles[number], "passenger", "Car")
                assert (int(row["points"]), row["in_roi"]) == (on[number], str(int(number in targets)))


def bytes_of(folder):
    return {str(path.relative_to(folder)): files.hash_file(path) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_bytes_do_not_depend_on_threads(four_sites, tmp_path, kind):
    for name, jobs in (("a", 1), ("b", 2)):
        write_dataset(load(four_sites), tmp_path / name, sites=["tilted", "level"], frames=FRAMES, kind=kind, jobs=jobs)
    assert bytes_of(tmp_path / "a") == bytes_of(tmp_path / "b")
    folders = {path.name for path in (tmp_path / "a").iterdir()}
    assert folders == {"README.md", "tilted", "level"}
    assert {path.name for path in tmp_path.iterdir() if path.name.startswith(".")} == set()


def test_readme_matches_files(four_sites, tmp_path):
    done = write_dataset(load(four_sites, ["effects.dropout.share=0.2"]), tmp_path / "out", frames=FRAMES, kind="kitti")
    text = (tmp_path / "out" / "README.md").read_text()
    rows = {
        row[0]: row for line in text.splitlines() if len(row := [w.strip() for w in line.strip("|").split("|")]) == 13
    }
    classes = dict(re.findall(r"^\| ([A-Z]\w+) \| (\d+) \|$", text, re.M))
    lines = points = 0
    for summary in done.sites:
        folder = tmp_path / "out" / summary.site
        sizes = [path.stat().st_size // 16 for path in (folder / "velodyne").iterdir()]
        labels = [line for path in (folder / "label_2").iterdir() for line in path.read_text().splitlines()]
        objects = list(csv.DictReader((folder / "objects.csv").read_text().splitlines()))
        targets = [row for row in objects if row["in_roi"] == "1"]
        counts = [len(sizes), sum(sizes), len(labels), len(targets), sum(row["points"] != "0" for row in targets)]
        assert rows[summary.site][8:] == [str(count) for count in counts]
        written = json.loads((folder / "about.json").read_text())
        assert [written[key] for key in ("frames", "points", "labelled", "in_roi", "in_roi_labelled")] == counts
        assert len(list((folder / "calib").iterdir())) == FRAMES
        lines, points = lines + len(labels), points + sum(sizes)
    assert classes == {"Car": str(lines)}
    assert f"4 sites, 10 frames each, {points} points; format kitti." in text
    assert "Effects on beams and returns: dropout; on traffic: none." in text
    assert "these are the frames that the TPOG was computed from" in text
    assert "at least 2 s apart" in text and "small 0." in text


def test_points_turned_back_lie_on_the_rings_of_the_sensor(four_sites, tmp_path):
    done = write_dataset(load(four_sites), tmp_path / "out", frames=2, kind="openpcdet")
    for summary in done.sites:
        folder = tmp_path / "out" / summary.site
        points = np.concatenate([np.load(path)[:, :3] for path in (folder / "points").iterdir()]).astype(float)
        turned = points @ np.array(json.loads((folder / "about.json").read_text())["T_level_sensor"])[:3, :3]
        elevation_deg = np.degrees(np.arcsin(turned[:, 2] / np.linalg.norm(turned, axis=1)))
        assert set(np.round(elevation_deg, 2)) <= set(np.linspace(-15, 5, 8).round(2)), summary.site


def test_openpcdet_grid_contains_labels(four_sites, tmp_path):
    done = write_dataset(load(four_sites), tmp_path / "out", frames=FRAMES, kind="openpcdet")
    for summary in done.sites:
        text = (tmp_path / "out" / summary.site / dataset.CONFIG_FILE).read_text()
        grid = [float(word) for word in re.search(r"POINT_CLOUD_RANGE: \[(.*)\]", text)[1].split(",")]
        voxel = [float(word) for word in re.search(r"VOXEL_SIZE: \[(.*)\]", text)[1].split(",")]
        cells = (np.array(grid[3:]) - grid[:3]) / voxel
        np.testing.assert_allclose(cells, cells.round(), atol=1e-6)
        assert cells[2] == pytest.approx(40) and not (cells[:2].round() % 16).any()
        if summary.labelled:
            assert (np.array(summary.low_m) >= grid[:3]).all() and (np.array(summary.high_m) <= grid[3:]).all()
        assert ("gt_sampling" in text) == bool(summary.pasted)
        assert text.count("{") == text.count("}")
        ground = -{"level": 3, "tilted": 4, "rolled": 5, "behind": 6.2}[summary.site]
        anchor = "'Car', 'anchor_sizes': [[4.5, 1.8, 1.5]]", f"'anchor_bottom_heights': [{ground}]"
        assert all((words in text) == bool(summary.labelled) for words in anchor)


# ---- bad input


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--site", "levl"], "--site: there is no site 'levl'. Choose one of level, "),
        (["--site", "x9"], "--site: there is no site 'x9'. Choose one of level, tilted, rolled, behind"),
        (["--frames", "11"], "--frames: expected at most 10 frames at least 2 s apart, got 11"),
        (["--frames", "0"], "--frames"),
        (["--format", "waymo"], "--format: unknown format 'waymo'. Use one of kitti, openpcdet, ply, pcd"),
    ],
)
def test_rejects_wrong_options_and_writes_nothing(four_sites, tmp_path, run_egvs, words, message):
    code, _, err = run_egvs("clouds", four_sites, "--frames", 2, "--out", tmp_path / "out", *words)
    assert code == 2 and message in err
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))


def test_overwrites_nothing(four_sites, tmp_path, run_egvs):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("mine")
    for out, message in (
        ("full", "the folder is not empty"),
        ("full/mine.txt", "expected a folder, got a file"),
        ("full/mine.txt/a", "cannot be written"),
    ):
        code, _, err = run_egvs("clouds", four_sites, "--frames", 2, "--out", tmp_path / out)
        assert code == 2 and message in err
    assert [path.name for path in tmp_path.rglob("*mine*")] == ["mine.txt"]


def test_rejects_full_disk_before_writing(four_sites, tmp_path, monkeypatch):
    class Full:
        free = 1000

    monkeypatch.setattr(dataset.shutil, "disk_usage", lambda _: Full)
    with pytest.raises(InputError, match=r"GB, but 0\.0 GB are free\. Use fewer --frames"):
        write_dataset(load(four_sites), tmp_path / "out", frames=FRAMES)
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".out*"))


def test_rejects_sites_that_cannot_be_exported(four_sites, tmp_path):
    (four_sites / "sites.csv").write_text("site,x_m,y_m,z_m,points\n..,10,8,3,\nmeasured,12,8,3,scan.ply\n")
    with pytest.raises(InputError, match=r"site \.\.: its name is reserved in the exported folder"):
        write_dataset(load(four_sites), tmp_path / "out", sites=[".."], frames=2)
    with pytest.raises(InputError, match="site measured: its empty scan was measured"):
        write_dataset(load(four_sites), tmp_path / "out", sites=["measured"], frames=2)


def test_removes_files_of_killed_export_and_fills_empty_folder(four_sites, tmp_path, run_egvs):
    (tmp_path / ".out.partial" / "level").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    code, out, _ = run_egvs("clouds", four_sites, "--frames", 2, "--site", "level", "--out", tmp_path / "out")
    assert code == 0 and "level" in out and "README.md" in out
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"README.md", "level"}
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.slow
def test_run_folder_stands_for_its_scenario(mini, tmp_path, run_egvs):
    assert run_egvs("run", mini, "--out", tmp_path / "run")[0] == 0
    for number, path in enumerate((mini, tmp_path / "run")):
        code, _, error = run_egvs("clouds", path, "--frames", 2, "--out", tmp_path / f"clouds{number}")
        assert code == 0, error
    files = sorted(path.relative_to(tmp_path / "clouds0") for path in (tmp_path / "clouds0").rglob("*.bin"))
    assert files
    assert all(
        (tmp_path / "clouds0" / name).read_bytes() == (tmp_path / "clouds1" / name).read_bytes() for name in files
    )


def test_long_vehicles_without_class_are_no_cars(four_sites, tmp_path, run_egvs):
    """The type of vehicle names no vClass, so SUMO's default, passenger, is that of a 12 m bus."""
    words = ("--site", "level", "--frames", "2", "--set", "traffic.kinds.car.length_m=12")
    code, printed, _ = run_egvs("clouds", four_sites, "--out", tmp_path / "clouds", *words)
    names = {name for path in (tmp_path / "clouds/level/label_2").iterdir() for name in kitti.read_labels(path).names}
    assert (code, names) == (0, {"Bus"})
    said = re.search(r"Labelled by size: (\d+) Bus\. Their vClass is that of cars, but .* longer than 6\.5 m", printed)
    assert said is not None and said[0] in (tmp_path / "clouds" / "README.md").read_text()
    about = json.loads((tmp_path / "clouds" / "level" / "about.json").read_text())
    assert about["by_size"] == about["classes"] == {"Bus": int(said[1])}


@pytest.mark.slow
def test_python_function_writes_the_files_of_the_command(four_sites, tmp_path, run_egvs):
    words = ("--site", "level", "--frames", "2", "--format", "ply")
    assert run_egvs("clouds", four_sites, "--out", tmp_path / "one", *words)[0] == 0
    other = write_clouds(load(four_sites), str(tmp_path / "other"), sites=["level"], frames=2, format="ply")
    for path in (tmp_path / "one").rglob("*.*"):
        assert (other / path.relative_to(tmp_path / "one")).read_bytes() == path.read_bytes()
    with pytest.raises(InputError, match="is not empty"):
        write_clouds(load(four_sites), other, frames=2)


def test_python_function_refuses_no_frames_and_one_text(four_sites, tmp_path):
    scenario = load(four_sites)
    with pytest.raises(InputError, match=r"^frames: expected at least 1, got 0"):
        write_clouds(scenario, tmp_path / "none", frames=0)
    with pytest.raises(InputError, match=r"^sites: expected a list of texts, got 'level'\. Write .*sites=\['level'\]"):
        write_clouds(scenario, tmp_path / "none", frames=1, sites="level")
    assert not (tmp_path / "none").exists()

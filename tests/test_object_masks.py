# SPDX-FileCopyrightText: 2026 The slam_graph authors
# SPDX-License-Identifier: Apache-2.0
"""Masks of objects: folders of label images and boxes, what is wrong with them, runs with them."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from slam_graph.backend.objects.track_labels import TrackLabels
from slam_graph.cli.main import app
from slam_graph.datasets import RecordedSequence, open_dataset
from slam_graph.datasets.object_sources import LabelsOverTime
from slam_graph.datasets.streams.mask_images import MaskFolder, sampled
from slam_graph.errors import DataError
from slam_graph.pipeline import run
from slam_graph.results import RunResult
from slam_graph.sensors import FeatureFrame, FeatureObservations
from slam_graph.simulation.simulated_sequence import SimulatedSequence
from slam_graph.simulation.simulator import simulate

SIZE = (60, 40)


def folder_of(folder: Path, boxes: str = "", classes: str = "", image: Any = None) -> MaskFolder:
    folder.mkdir()
    if image is not None:
        cv2.imwrite(str(folder / "100.png"), image)
    if boxes:
        (folder / "boxes.csv").write_text(boxes)
    if classes:
        (folder / "classes.csv").write_text(classes)
    return MaskFolder(folder)


def labels_at(masks: MaskFolder, stamp_ns: int, *pixels: tuple[float, float]) -> list[int] | None:
    image = masks.image(stamp_ns, SIZE)
    return None if image is None else sampled(image, np.array(pixels, float)).tolist()


def square() -> Any:
    image = np.zeros((40, 60), np.uint16)
    image[10:30, 20:40] = 7
    return image


def test_masks_are_read_as_images_and_as_boxes(tmp_path: Path) -> None:
    folder = tmp_path / "masks"
    masks = folder_of(folder, "#stamp,label,l,t,r,b\n20000000,3,20,10,39,29\n", "7,car\n", square())
    pixels = (30.0, 20.0), (5.0, 5.0), (20.0, 20.0), (39.6, 20.0)
    assert labels_at(masks, 100, *pixels) == [7, 0, 0, 0], "at a border it may be on either side"
    assert labels_at(masks, 20_000_000, *pixels) == [3, 0, 0, 0]
    assert masks.image(10_000_000, SIZE) is None
    assert masks.classes == {7: "car"}
    assert len(masks) == 2


def test_boxes_belong_to_every_stamp_to_the_last_digit(tmp_path: Path) -> None:
    """Floats of today's stamps are multiples of 256 ns."""
    stamps = [1_700_000_000_000_000_123 + 50_000_001 * k for k in range(8)]
    masks = folder_of(tmp_path / "masks", "".join(f"{stamp},7,1,1,9,9\n" for stamp in stamps))
    assert [labels_at(masks, stamp, (5.0, 5.0)) for stamp in stamps] == [[7]] * 8


def test_what_is_near_a_thin_mask_has_no_label(tmp_path: Path) -> None:
    thin = np.zeros((40, 60), np.uint8)
    thin[20, 30] = 1
    masks = folder_of(tmp_path / "masks", image=thin)
    assert labels_at(masks, 100, (30.0, 20.0), (29.0, 19.0)) == [0, 0]


@pytest.mark.parametrize("box", ["-30,5,-2,20", "70,5,90,20", "5,-30,20,-2", "5,50,20,90"])
def test_a_box_out_of_the_image_labels_nothing(tmp_path: Path, box: str) -> None:
    image = folder_of(tmp_path / "masks", f"100,3,{box}\n").image(100, SIZE)
    assert image is not None
    assert not image.any()


def test_a_box_over_the_border_labels_what_is_inside(tmp_path: Path) -> None:
    image = folder_of(tmp_path / "masks", "100,3,-1e30,-4,9.5,1e30\n").image(100, SIZE)
    assert image is not None
    assert image.sum() == 3 * 10 * 40


def test_names_may_be_seconds(tmp_path: Path) -> None:
    """As those of TUM RGB-D, whose stamps are rounded to microseconds."""
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "1311867170.462290.png"), square())
    masks = MaskFolder(tmp_path / "masks")
    assert labels_at(masks, 1311867170462290123, (30.0, 20.0)) == [7]
    assert masks.image(1311867170464000000, SIZE) is None


def test_a_label_image_of_another_size_is_refused(tmp_path: Path) -> None:
    masks = folder_of(tmp_path / "masks", image=square())
    with pytest.raises(DataError, match=r"100\.png: a label image has one channel.*30 x 40"):
        masks.image(100, (30, 40))
    cv2.imwrite(str(tmp_path / "masks" / "100.png"), np.zeros((40, 60, 3), np.uint8))
    with pytest.raises(DataError, match="one channel"):
        masks.image(100, SIZE)
    (tmp_path / "masks" / "100.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"100\.png"):
        masks.image(100, SIZE)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "holds neither"),
        ({"frame_0001.png": ""}, "holds neither"),
        ({"\u00b2.png": ""}, "holds neither"),
        ({"99999999999999999999.png": ""}, "holds neither"),
        ({"boxes.csv": "1,1,5,5,1,1\n"}, "beyond its right"),
        ({"boxes.csv": "1,0,1,1,5,5\n"}, "label is not 1 to"),
        ({"boxes.csv": "1,1,nan,1,5,5\n"}, "not finite"),
        ({"boxes.csv": "1,car,1,1,5,5\n"}, r"boxes\.csv:1"),
        ({"boxes.csv/": ""}, r"boxes\.csv: cannot be read"),
        ({"1.png": "", "classes.csv": "car,7\n"}, r"classes\.csv:1: expected a label"),
        ({"1.png": "", "classes.csv": "\u00b2,car\n"}, r"classes\.csv:1: expected a label"),
        ({"1.png": "", "classes.csv/": ""}, r"classes\.csv: cannot be read"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(
    tmp_path: Path, files: dict[str, str], message: str
) -> None:
    for name, text in files.items():
        if name.endswith("/"):
            (tmp_path / name).mkdir()
        else:
            (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(DataError, match=message):
        MaskFolder(tmp_path)


def test_there_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder of masks"):
        MaskFolder(tmp_path / "none")


# --- runs ----------------------------------------------------------------------------------------


def estimated(sequence: SimulatedSequence, **changes: Any) -> RunResult:
    always = {"objects.enabled": True, "final_ba.enabled": False}
    return run(sequence, overrides={**always, **changes})


@pytest.mark.slow
def test_masks_keep_three_objects_apart() -> None:
    objects = {"count": 3, "motion": "mixed", "masks": True}
    sequence = simulate(
        duration_s=8.0, rate_hz=10.0, seed=0, tracks={"pixel_sigma": 0.5}, objects=objects
    )
    result = estimated(sequence, **{"backend.noise.pixel_sigma": 0.5})
    found = result.metrics["moving_objects"]
    assert found["accuracy"]["identity_switches"] == 0
    assert found["accuracy"]["median_motion_translation_m"] < 0.012
    assert {row["label"] for row in found["objects"].values()} == {1, 2, 3}
    assert len(found["objects"]) == 3


def test_rendered_objects_come_with_masks_and_true_poses(tmp_path: Path) -> None:
    objects = {"count": 1, "masks": True}
    sequence = simulate(kind="images", duration_s=0.5, rate_hz=4.0, objects=objects)
    sequence.save(tmp_path / "flight")
    read = open_dataset(tmp_path / "flight")
    assert isinstance(read, RecordedSequence)
    truth = read.object_truth()[1]
    assert read.masks == len(truth)
    camera = sequence.rig.cameras[0]
    for stamp_ns, middle in zip(truth.stamps_ns.tolist(), truth.positions, strict=True):
        image = read.label_image(stamp_ns)
        assert image is not None
        assert set(np.unique(image)) == {0, 1}
        body = sequence.groundtruth().at(stamp_ns)
        local = body.compose(camera.body_T_camera).transformTo(middle)
        u, v = camera.camera.distort(local[None, :2] / local[2])[0][0]
        assert image[round(v), round(u)] == 1, "the middle of a box is behind its face"


@pytest.fixture(scope="module")
def still_world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """Two seconds of images in which nothing moves, and the stamps of the frames."""
    folder = tmp_path_factory.mktemp("still") / "flight"
    sequence = simulate(kind="images", duration_s=2.0, rate_hz=10.0)
    sequence.save(folder)
    images = (folder / "mav0" / "cam0" / "data").glob("*.png")
    return folder, sorted(int(image.stem) for image in images)


def given_boxes(folder: Path, stamps_ns: list[int]) -> Path:
    """A box in the middle of each image."""
    folder.mkdir()
    rows = "".join(f"{stamp},4,250,150,500,330\n" for stamp in stamps_ns)
    (folder / "boxes.csv").write_text(rows)
    (folder / "classes.csv").write_text("4,car\n")
    return folder


def run_with_masks(recording: Path, masks: Path, output: Path) -> dict[str, Any]:
    """What `slam-graph run --source masks=…` says of moving objects, and its warnings."""
    arguments = ["run", str(recording), "--objects", "--source", f"masks={masks}", "--no-final-ba"]
    done = CliRunner().invoke(app, [*arguments, "--output", str(output)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    metrics: dict[str, Any] = json.loads(next(output.rglob("metrics.json")).read_text("utf-8"))
    return metrics


def test_a_parked_car_is_no_moving_object(
    still_world: tuple[Path, list[int]], tmp_path: Path
) -> None:
    recording, stamps = still_world
    masks = given_boxes(tmp_path / "masks", stamps)
    metrics = run_with_masks(recording, masks, tmp_path / "out")
    assert metrics["moving_objects"]["objects"] == {}
    assert "masks_unused" not in metrics["warnings"]


def test_masks_of_another_recording_are_not_used_in_silence(
    still_world: tuple[Path, list[int]], tmp_path: Path
) -> None:
    recording, stamps = still_world
    masks = given_boxes(tmp_path / "masks", [stamp + 10**12 for stamp in stamps])
    metrics = run_with_masks(recording, masks, tmp_path / "out")
    assert metrics["warnings"]["masks_unused"] == 1


def test_a_track_keeps_the_label_of_its_last_mask(
    still_world: tuple[Path, list[int]], tmp_path: Path
) -> None:
    """Masks may be fewer than frames."""
    recording, stamps = still_world
    masks = given_boxes(tmp_path / "masks", stamps[:1])
    opened = open_dataset(recording, sources={"masks": str(masks)})
    assert isinstance(opened, RecordedSequence)
    labels = LabelsOverTime(opened)
    for stamp, ids, expected in (
        (stamps[0], [1, 2], [4, 0]),
        (stamps[1], [2, 1, 3], [0, 4, 0]),
        (stamps[2], [3, 1], [0, 4]),
    ):
        pixels = np.array([[300.0, 200.0] if number == 1 else [10.0, 10.0] for number in ids])
        seen = FeatureObservations(np.array(ids), pixels, pixels)
        frame = labels.labelled(FeatureFrame(stamp, (seen,)))
        found = TrackLabels(frame)
        assert found.given
        assert found.of(np.array(ids)).tolist() == expected
    assert labels.frames == 1

"""Recordings in DexYCB's format: what is read, in which frame, what is refused, and a corpus of broken ones."""

import io
import re
import shutil
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tasks.dexycb.recording import JOINT_NAMES, YCB_NAMES, RecordingError, read_recording, read_vertices, sequences
from tasks.dexycb.scene import FINGER_DIRECTION, SceneError, _upright_box, scene_of
from tasks.dexycb.standin import SERIALS, hand_joints, thumb_joints, write_standin
from tasks.objects import OBJECTS
from tasks.pick import OBJECT_XY
from tasks.table import TABLE_TOP

FRAMES = 10
MASTER, SECOND = SERIALS


@pytest.fixture(scope="module")
def standin(tmp_path_factory):
    """A stand-in of one object, its fifth recording of a left hand."""
    root = tmp_path_factory.mktemp("standin") / "root"
    write_standin(root, ["061_foam_brick"], each=5, seed=3, frames=FRAMES)
    return root


@pytest.fixture
def one(standin, tmp_path):
    """The first recording alone, to be spoilt: its root."""
    name = sequences(standin)[0]
    root = tmp_path / "root"
    shutil.copytree(standin / name, root / name)
    shutil.copytree(standin / "calibration", root / "calibration")
    return root


def only(root):
    return sequences(root)[0]


def edit_yaml(file, change):
    content = yaml.safe_load(file.read_text().replace("!!python/tuple", ""))
    change(content)
    file.write_text(yaml.dump(content))


def edit_npz(file, change):
    with np.load(file) as arrays:
        content = dict(arrays)
    change(content)
    np.savez_compressed(file, **content)


def label(root, frame=4, serial=MASTER):
    return root / only(root) / serial / f"labels_{frame:06d}.npz"


# -- what is read --------------------------------------------------------------------------------------------


def test_a_recording_is_read_in_the_table_frame(standin):
    """By an independent route: labels, extrinsics and tag by SciPy, as the format's own tools use them."""
    name = sequences(standin)[0]
    recording = read_recording(standin, name)
    text = (standin / "calibration" / "extrinsics_20260101_000000" / "extrinsics.yml").read_text()
    poses = {k: np.array(v).reshape(3, 4) for k, v in yaml.safe_load(text.replace("!!python/tuple", ""))["extrinsics"].items()}
    frame = 6
    camera = recording.hand_camera[frame]
    joints = np.load(standin / name / camera / f"labels_{frame:06d}.npz")["joint_3d"][0].astype(float)
    in_world = joints @ poses[camera][:, :3].T + poses[camera][:, 3]
    in_tag = (in_world - poses["apriltag"][:, 3]) @ poses["apriltag"][:, :3]
    np.testing.assert_allclose(recording.joints[frame], in_tag, atol=1e-6)
    row = np.load(standin / name / "pose.npz")["pose_y"][frame, 0].astype(float)
    world = Rotation.from_quat(row[:4]).as_matrix()
    np.testing.assert_allclose(recording.rotations[frame, 0], poses["apriltag"][:, :3].T @ world, atol=1e-5)
    np.testing.assert_allclose(recording.positions[frame, 0], (row[4:] - poses["apriltag"][:, 3]) @ poses["apriltag"][:, :3], atol=1e-6)


def test_cameras_agree_about_the_hand(standin):
    name = sequences(standin)[0]
    first = read_recording(standin, name)
    seen = [f for f in range(FRAMES) if first.hand_camera[f] == MASTER]
    other = np.stack([np.load(standin / name / SECOND / f"labels_{f:06d}.npz")["joint_3d"][0] for f in seen])
    lengths = np.linalg.norm(np.diff(other[:, 1:5], axis=1), axis=2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(first.joints[seen, 1:5], axis=1), axis=2), lengths, atol=1e-6)


def test_missing_hands_and_objects_are_nan(one):
    edit_npz(one / only(one) / "pose.npz", lambda a: (a["pose_y"].__setitem__((3, 0), [0, 0, 0, 1, 0, 0, 0]),
                                                      a["pose_y"].__setitem__((4, 0), 0)))
    for serial in SERIALS:
        edit_npz(label(one, 5, serial), lambda a: a["joint_3d"].fill(-1))
    recording = read_recording(one, only(one))
    assert np.isnan(recording.positions[3:5, 0]).all() and np.isfinite(recording.positions[5, 0]).all()
    assert np.isnan(recording.joints[5]).all() and recording.hand_camera[5] == ""
    assert not recording.hand_seen[5] and not recording.object_seen[3]


def test_the_second_camera_helps_out(one):
    before = read_recording(one, only(one))
    edit_npz(label(one, 6), lambda a: a["joint_3d"].fill(-1))
    after = read_recording(one, only(one))
    assert (before.hand_camera[6], after.hand_camera[6]) == (MASTER, SECOND)
    np.testing.assert_allclose(after.joints[6], before.joints[6], atol=1e-5)
    shutil.rmtree(one / only(one) / MASTER)
    np.testing.assert_allclose(read_recording(one, only(one)).joints[7], before.joints[7], atol=1e-5)


def test_a_left_hand_is_mirrored_into_a_right_one(standin):
    left = read_recording(standin, sequences(standin)[4])
    assert left.side == "left" and left.mirrored
    frame = int(np.flatnonzero(left.hand_seen)[-1])
    for recording in (left, read_recording(standin, sequences(standin)[0])):
        wrist, index, little = (recording.joints[frame, JOINT_NAMES.index(n)] for n in ("wrist", "index_mcp", "little_mcp"))
        # Palm down, fingers away from the wrist: a right hand has its index to the left of the little finger.
        assert np.cross(index - wrist, little - wrist)[2] < 0, f"{recording.name} is no right hand palm down"
        assert np.linalg.det(recording.rotations[frame, 0]) > 0.99


def test_names_and_frame_rate(standin):
    names = sequences(standin)
    assert len(names) == 5 and all(re.fullmatch(r"20260101-subject-01/20260101_\d{6}", name) for name in names)
    assert read_recording(standin, names[0], frame_rate=30).frame_rate == 30
    for rate in (0, -1, float("nan"), 1e9):
        with pytest.raises(RecordingError, match="frame rate"):
            read_recording(standin, names[0], frame_rate=rate)
    assert len(YCB_NAMES) == 21 and YCB_NAMES[7 - 1] == "008_pudding_box" and YCB_NAMES[21 - 1] == "061_foam_brick"


# -- the stand-in --------------------------------------------------------------------------------------------


def test_a_standin_is_its_seed(standin, tmp_path):
    again = tmp_path / "again"
    write_standin(again, ["061_foam_brick"], each=5, seed=3, frames=FRAMES)
    files = sorted(p.relative_to(standin) for p in standin.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert all((standin / f).read_bytes() == (again / f).read_bytes() for f in files)
    assert "nothing here was recorded" in (standin / "README.md").read_text()


def test_a_whole_standin_is_small(standin):
    """Size grows with frames and recordings: 25 recordings of 42 frames, from one of ten."""
    one = sum(f.stat().st_size for f in (standin / sequences(standin)[0]).rglob("*") if f.is_file())
    assert one * 42 / FRAMES * 25 < 5e6, f"{one} bytes for {FRAMES} frames"


def test_bones_keep_their_length():
    for closing in (0.0, 0.4, 1.0):
        thumb = thumb_joints(closing, 0.19, np.array([0.03, -0.04, 0.02]))
        np.testing.assert_allclose(np.linalg.norm(np.diff(thumb, axis=0), axis=1), 0.19 * np.array([0.251, 0.196, 0.158]), rtol=1e-6)
        hand = hand_joints([closing] * 5, 0.19, np.array([0.03, -0.04, 0.02]))
        assert hand.shape == (21, 3)
        np.testing.assert_allclose(np.linalg.norm(np.diff(hand[5:9], axis=0), axis=1), 0.19 * np.array([0.245, 0.143, 0.097]), rtol=1e-6)
    closed = thumb_joints(1.0, 0.19, np.array([0.03, -0.04, 0.02]))
    np.testing.assert_allclose(closed[-1], [0.03, -0.04, 0.02], atol=1e-6)


@pytest.mark.parametrize("arguments", [{"objects": ["cup"]}, {"each": 0}, {"frames": 3}, {"seed": -1}, {"objects": []}])
def test_an_impossible_standin_is_refused(tmp_path, arguments):
    with pytest.raises(ValueError, match="cup|cannot be made"):
        write_standin(tmp_path / "x", **arguments)
    assert not (tmp_path / "x").exists()


def test_a_folder_with_files_is_left_alone(tmp_path):
    (tmp_path / "mine.txt").write_text("dear")
    with pytest.raises(ValueError, match="exists and is not an empty folder"):
        write_standin(tmp_path)


# -- the scene -----------------------------------------------------------------------------------------------


def test_a_scene_starts_and_ends_where_the_object_does(standin):
    for name in sequences(standin):
        recording = read_recording(standin, name)
        scene = scene_of(recording)
        poses, item = scene.object_poses(recording), scene.task.object
        assert item == OBJECTS["061_foam_brick"] and scene.standard
        np.testing.assert_allclose(poses[scene.first, :3, 3], [*OBJECT_XY, TABLE_TOP + item.half_height], atol=0.004)
        start, goal = scene.task.sample_start(np.random.default_rng(0))
        np.testing.assert_allclose(goal, poses[scene.last, :3, 3], atol=0.004)
        assert 0.15 < goal[2] - start[2] < 0.25, "synthetic hands lift by 0.17 to 0.23 m"
        hand = scene.joints(recording)[scene.grasped]
        along = (hand[JOINT_NAMES.index("middle_mcp")] - hand[0])[:2]
        assert along @ FINGER_DIRECTION > 0.8 * np.linalg.norm(along), "the hand does not come from the robot's side"
        # Nothing but a turn about the vertical and a shift.
        np.testing.assert_allclose(scene.task_from_table[:3, :3] @ [0, 0, 1], [0, 0, 1], atol=1e-12)
        assert abs(np.linalg.det(scene.task_from_table[:3, :3]) - 1) < 1e-12


def test_the_smallest_upright_box_is_found():
    rng = np.random.default_rng(0)
    corners = np.array(np.meshgrid([-0.05, 0.05], [-0.02, 0.02], [-0.03, 0.03])).reshape(3, -1).T
    for yaw in rng.uniform(-np.pi, np.pi, 8):
        turned = corners @ Rotation.from_rotvec([0, 0, yaw]).as_matrix().T + [0.3, 0.2, 0.03]
        found, low, high = _upright_box(turned)
        np.testing.assert_allclose((high - low) / 2, [0.05, 0.02, 0.03], atol=6e-4)
        assert abs(np.sin(found - yaw)) < np.deg2rad(0.5), "the long side is not along its x"


def write_mesh(root, name, corners):
    folder = root / "models" / name
    folder.mkdir(parents=True)
    (folder / "textured_simple.obj").write_text("\n".join(["# a box", *(f"v {x} {y} {z}" for x, y, z in corners), "f 1 2 3"]))


def test_a_mesh_gives_size_and_table(one):
    corners = np.array(np.meshgrid([-0.05, 0.05], [-0.02, 0.02], [-0.0255, 0.0355])).reshape(3, -1).T
    write_mesh(one, "061_foam_brick", corners)
    recording = read_recording(one, only(one))
    vertices = read_vertices(one, "061_foam_brick")
    scene = scene_of(recording, vertices)
    assert not scene.standard and scene.task.object.shape == "box"
    np.testing.assert_allclose(scene.task.object.half_size, [0.05, 0.02, 0.0305], atol=1e-3)
    # The primitive's centre is the mesh's, 5 mm above its origin, and the lowest vertex lies on the table.
    np.testing.assert_allclose(scene.object_from_primitive[:3, 3], [0, 0, 0.005], atol=1e-3)
    assert read_vertices(one, "024_bowl") is None


@pytest.mark.parametrize("text, said", [("", "at least 4"), ("v 1 2\nv 1 2 3\n", "v x y z|at least 4"), ("v a b c\n", "v x y z"),
                                        ("v 0 0 0\nv 70 0 0\nv 0 80 0\nv 0 0 30\n", "metres"), ("v nan 0 0\n" * 4, "finite")])
def test_a_broken_mesh_is_refused(one, text, said):
    folder = one / "models" / "061_foam_brick"
    folder.mkdir(parents=True)
    (folder / "textured_simple.obj").write_text(text)
    with pytest.raises(RecordingError, match=said):
        read_vertices(one, "061_foam_brick")


def test_no_pick_is_said(one):
    def still(a):
        a["pose_y"][:, 0] = a["pose_y"][0, 0]

    edit_npz(one / only(one) / "pose.npz", still)
    for frame in range(FRAMES):
        for serial in SERIALS:
            edit_npz(label(one, frame, serial), lambda a: a["pose_y"].fill(0))
    with pytest.raises(SceneError, match="a pick moves it"):
        scene_of(read_recording(one, only(one)))


def test_an_object_without_geometry_is_said(one):
    edit_yaml(one / only(one) / "meta.yml", lambda m: m.__setitem__("ycb_ids", [15, *m["ycb_ids"][1:]]))
    with pytest.raises(SceneError, match="no primitive of 035_power_drill; put its mesh in models/035_power_drill"):
        scene_of(read_recording(one, only(one)))


# -- what is refused -----------------------------------------------------------------------------------------


def spoil_meta(key, value):
    def spoil(root):
        edit_yaml(root / only(root) / "meta.yml", lambda m: m.pop(key) if value is None else m.__setitem__(key, value))

    return spoil


def spoil_label(change, every=False):
    def spoil(root):
        for frame in range(FRAMES) if every else [4]:
            for serial in SERIALS:
                edit_npz(label(root, frame, serial), change)

    return spoil


def spoil_pose(change):
    return lambda root: edit_npz(root / only(root) / "pose.npz", change)


def spoil_extrinsics(change):
    return lambda root: edit_yaml(next(root.glob("calibration/extrinsics_*/extrinsics.yml")), change)


def scaled(key, factor):
    return lambda a: a.__setitem__(key, (a[key] * np.float32(factor)).astype(np.float32))


CASES = {
    "no num_frames": (spoil_meta("num_frames", None), r"meta.yml: num_frames: expected a whole number .* found nothing"),
    "frames as text": (spoil_meta("num_frames", "many"), "num_frames: .* found 'many'"),
    "too many frames": (spoil_meta("num_frames", FRAMES + 1), r"pose_y: expected shape \(11, 3, 7\), found \(10, 3, 7\)"),
    "index beyond objects": (spoil_meta("ycb_grasp_ind", 3), "ycb_grasp_ind: expected a whole number from 0 to 2, found '3'"),
    "unknown object": (spoil_meta("ycb_ids", [22, 1, 2]), "ycb_ids: .* 1 to 21, found '22'"),
    "two hands": (spoil_meta("mano_sides", ["left", "right"]), "mano_sides: expected .* found 2 entries"),
    "a foot": (spoil_meta("mano_sides", ["foot"]), "mano_sides: .*'foot'"),
    "a path": (spoil_meta("extrinsics", "../../etc"), "extrinsics: expected a plain name, found '../../etc'"),
    "serial twice": (spoil_meta("serials", [MASTER, MASTER]), "serials: expected each camera once"),
    "no joint_3d": (spoil_label(lambda a: a.pop("joint_3d")), "labels_000004.npz: joint_3d: expected this key, found only"),
    "no seg": (spoil_label(lambda a: a.pop("seg")), "seg: expected this key"),
    "joints as integers": (spoil_label(lambda a: a.__setitem__("joint_3d", a["joint_3d"].astype(int))), "dtype float32 .* found int64"),
    "joints as objects": (spoil_label(lambda a: a.__setitem__("joint_3d", np.array([{}], object))), "dtype float32 .* found object"),
    "twenty joints": (spoil_label(lambda a: a.__setitem__("joint_3d", a["joint_3d"][:, :20])), r"expected shape \(1, 21, 3\)"),
    "joints in millimetres": (spoil_label(scaled("joint_3d", 1000)), "joint_3d: expected 0.1 to 5.0 m .* are they in metres"),
    "joints in kilometres": (spoil_label(scaled("joint_3d", 0.001)), "joint_3d: expected 0.1 to 5.0 m"),
    "a NaN joint": (spoil_label(lambda a: a["joint_3d"].__setitem__((0, 3, 1), np.nan)), r"joint_3d: expected finite numbers, found nan at \[0, 3, 1\]"),  # noqa: E501
    "a huge hand": (spoil_label(lambda a: a["joint_3d"].__setitem__((0, 8, 0), 2.0)), "a hand of .* from wrist"),
    "objects in millimetres": (spoil_pose(lambda a: a["pose_y"].__setitem__((..., slice(4, 7)), a["pose_y"][..., 4:] * 1000)), "pose_y: expected 0.1 to 5.0 m .*are they in metres"),  # noqa: E501
    "quaternion not a unit": (spoil_pose(lambda a: a["pose_y"].__setitem__((2, 0, slice(0, 4)), 2)), "unit quat.* frame 2, object 0"),
    "label object elsewhere": (spoil_label(lambda a: a["pose_y"].__setitem__((0, 0, 3), 3.0)), r"pose_y\[0\]: expected the object within 0.05 m"),  # noqa: E501
    "never a hand": (spoil_label(lambda a: a["joint_3d"].fill(-1), every=True), "joint_3d: expected a hand in a frame, found none"),
    "no apriltag": (spoil_extrinsics(lambda c: c["extrinsics"].pop("apriltag")), "extrinsics.apriltag: expected 12 numbers"),
    "eleven numbers": (spoil_extrinsics(lambda c: c["extrinsics"][MASTER].pop()), "expected 12 numbers, .*, found a list of 11"),
    "tag in millimetres": (spoil_extrinsics(lambda c: c["extrinsics"].__setitem__("apriltag", [n * (1000 if i % 4 == 3 else 1) for i, n in enumerate(c["extrinsics"]["apriltag"])])), "a translation below 5.0 m"),  # noqa: E501
    "tag in kilometres": (spoil_extrinsics(lambda c: c["extrinsics"].__setitem__("apriltag", [n / (1000 if i % 4 == 3 else 1) for i, n in enumerate(c["extrinsics"]["apriltag"])])), "check apriltag"),  # noqa: E501
    "no rotation": (spoil_extrinsics(lambda c: c["extrinsics"].__setitem__("apriltag", [0.0] * 12)), "not orthonormal"),
    "unknown master": (spoil_extrinsics(lambda c: c.__setitem__("master", "1234")), "master: expected one of the recording's serials"),
}


@pytest.mark.parametrize("case", CASES)
def test_what_is_wrong_is_named(one, case):
    spoil, said = CASES[case]
    spoil(one)
    with pytest.raises(RecordingError, match=said) as refused:
        read_recording(one, only(one))
    assert str(one) in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("text", [
    "!!python/object/apply:os.system ['touch pwned']", "a: !!python/name:os.system ''", "serials: !!python/object/new:list [1]",
    "a: &a [*a]", "[" * 3000, "{", "serials: [", "\x00", "- a\n- b", "", "a: 1\n a: 2", "? [1]\n: 2",
])
def test_hostile_yaml_runs_nothing(one, text, monkeypatch):
    monkeypatch.chdir(one)
    (one / only(one) / "meta.yml").write_text(text)
    with pytest.raises(RecordingError):
        read_recording(one, only(one))
    assert not (one / "pwned").exists()


def test_yaml_laughs_once(one):
    names = "abcdefghijklm"
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]" for old, new in zip(names, names[1:], strict=False)]
    (one / only(one) / "meta.yml").write_text("\n".join([*lines, "serials: *m"]))
    start = time.process_time()
    with pytest.raises(RecordingError) as refused:
        read_recording(one, only(one))
    assert time.process_time() - start < 5 and len(str(refused.value)) < 1000


def test_a_pickle_is_not_loaded(one):
    class Evil:
        def __reduce__(self):
            return (Path.touch, (one / "pwned",))

    np.savez(one / only(one) / "pose.npz", pose_y=np.array([Evil()], object), pose_m=np.zeros((FRAMES, 1, 51), np.float32))
    with pytest.raises(RecordingError, match="dtype"):
        read_recording(one, only(one))
    assert not (one / "pwned").exists()


def test_a_zip_bomb_is_not_unpacked(one):
    """A header that promises the right shape before gigabytes of zeros; another that promises terabytes."""
    for shape, said in (((1, 21, 3), "shorter or longer"), ((10**6, 10**6, 3), "expected shape")):
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
        for serial in SERIALS:
            with np.load(label(one, 4, serial)) as arrays:
                content = dict(arrays)
            content.pop("joint_3d")
            np.savez_compressed(label(one, 4, serial), **content)
            with zipfile.ZipFile(label(one, 4, serial), "a", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("joint_3d.npy", header.getvalue() + bytes(10**7))
        with pytest.raises(RecordingError, match=said):
            read_recording(one, only(one))


# -- a corpus of broken recordings ---------------------------------------------------------------------------


def vital(root):
    """Files that a recording cannot be read without; one frame's labels stand for all. Arrays are stored plainly: faster, and
    no bit of them is padding."""
    folder = root / only(root)
    for file in (folder / "pose.npz", label(root)):
        with np.load(file) as arrays:
            np.savez(file, **dict(arrays))
    return [folder / "meta.yml", folder / "pose.npz", label(root), next(root.glob("calibration/extrinsics_*/extrinsics.yml"))]


def truncate(file, rng):
    data = file.read_bytes()
    # The last line of YAML may be cut within a value that is still whole; a quarter less never is.
    file.write_bytes(data[: int(rng.integers(0, int(0.75 * len(data))))])


def remove(file, rng):
    file.unlink()


def noise(file, rng):
    file.write_bytes(rng.bytes(int(rng.integers(1, 4000))))


def spoil_array(file, rng):
    with np.load(file) as arrays:
        content = dict(arrays)
    key = rng.choice(["pose_y", "joint_3d"] if "joint_3d" in content else ["pose_y"])
    array = content[key]
    kind = rng.integers(7)
    if kind == 0:
        del content[key]
    elif kind == 1:
        content[key] = array.astype(rng.choice(["int32", "float16", "complex64", "uint8", "U8", "?"]))
    elif kind == 2:
        array.reshape(-1)[rng.integers(array.size)] = rng.choice([np.nan, np.inf, -np.inf])
    elif kind == 3:
        content[key] = array[..., : int(rng.integers(0, array.shape[-1]))]
    elif kind == 4:
        content[key] = np.repeat(array, int(rng.integers(2, 5)), axis=int(rng.integers(array.ndim)))
    elif kind == 5:
        content[key] = array[..., 0] if rng.random() < 0.5 else array[None]
    else:  # units by 1000, either way
        factor = np.float32(rng.choice([1000.0, 0.001]))
        if key == "joint_3d":
            content[key] = array * factor
        elif array.shape[-1] == 7:
            array[..., 4:] *= factor
        else:
            array[..., 3] *= factor
    np.savez(file, **content)


def spoil_yaml(file, rng):
    content = yaml.safe_load(file.read_text().replace("!!python/tuple", ""))
    if "serials" in content:
        key = rng.choice([k for k in content if k != "mano_calib"])
        values = [None, -1, "", "x y", [], {}, [[]], 3.5, "../up", 10**9, ["left", "right"]]
    else:
        key = rng.choice(["master", MASTER, "apriltag"])
        values = [None, -1, "", [], {}, [0.0] * 12, [float("nan")] * 12, [1e6] * 12, [1.0] * 11, ["a"] * 12]
    value = values[rng.integers(len(values))]
    place = content["extrinsics"] if key in (MASTER, "apriltag") else content
    if value is None:
        place.pop(str(key))
    else:
        place[str(key)] = value
    file.write_text(yaml.dump(content))


def flip(file, rng):
    """A bit of what is stored: the checksum of a member that is read no longer holds."""
    with zipfile.ZipFile(file) as archive:
        member = archive.getinfo("pose_y.npy")
    data = bytearray(file.read_bytes())
    name, extra = struct.unpack("<HH", data[member.header_offset + 26 : member.header_offset + 30])
    start = member.header_offset + 30 + name + extra
    data[start + int(rng.integers(member.compress_size))] ^= 1 << int(rng.integers(8))
    file.write_bytes(bytes(data))


@pytest.mark.slow
def test_two_thousand_broken_recordings(one):
    """Each gets one sentence that names a file: no traceback, no other exception, no hang, and nothing accepted."""
    rng = np.random.default_rng(0)
    files = vital(one)
    kept = {file: file.read_bytes() for file in files}
    read_recording(one, only(one))
    name = only(one)
    spoils = {".yml": [truncate, remove, noise, spoil_yaml, spoil_yaml], ".npz": [truncate, remove, noise, flip, spoil_array, spoil_array]}
    accepted, slowest, seen = [], 0.0, set()
    for case in range(2000):
        file = files[rng.integers(len(files))]
        choices = spoils[file.suffix]
        spoil = choices[rng.integers(len(choices))]
        spoil(file, rng)
        start = time.process_time()
        try:
            read_recording(one, name)
            accepted.append((case, spoil.__name__, file.name, len(file.read_bytes()) if file.exists() else None))
        except RecordingError as error:
            said = str(error)
            assert said.startswith(str(one)) and "expected" in said and "\n" not in said and len(said) < 700, said
            seen.add(re.sub(r"\d+", "N", said.split(": ", 1)[1])[:60])
        slowest = max(slowest, time.process_time() - start)
        file.write_bytes(kept[file])
    assert not accepted, f"{len(accepted)} broken recordings were read, the first: {accepted[:5]}"
    assert len(seen) > 30 and slowest < 10, f"{len(seen)} kinds of sentences; the slowest took {slowest:.1f} s"
    read_recording(one, name)

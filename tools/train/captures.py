"""Photos with cameras and depth (RealEstate10K, DL3DV) as records like the generator's."""

import hashlib
import json
import sys
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image
from safetensors import safe_open

EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".webp", ".JPG", ".PNG")
# lens: fx, fy, cx, cy relative to the photo's sides. pose: camera to world, x right, y down,
# z forward. depth: folder and name.
Frame = namedtuple("Frame", "photo lens pose depth")
# Depth file of `zipsplat depth`.
DEPTHS = "depths.safetensors"
# One scene in about this many is for validation, at least one.
UNSEEN = 32
READERS = 4


def find_photo(folders, name):
    """Returns the first photo of this name in the folders, with or without an extension."""
    places = (folder / f"{name}{extension}" for folder in folders for extension in EXTENSIONS)
    return next((place for place in places if place.is_file()), None)


def re10k(file, depths):
    """Reads the frames of a RealEstate10K file NAME.txt; photos are in NAME/ or its folder."""
    frames = []
    for i, line in enumerate(file.read_text().splitlines()[1:], 2):
        fields = line.split()
        if not fields:
            continue
        if len(fields) != 19:
            raise ValueError(f"{file}: line {i}: found {len(fields)} numbers, expected 19")
        numbers = np.array(fields, dtype=np.float64)
        pose = np.linalg.inv(np.vstack((numbers[7:].reshape(3, 4), (0, 0, 0, 1))))
        photo = find_photo((file.with_suffix(""), file.parent), fields[0])
        frames.append(Frame(photo, numbers[1:5], pose, (depths or file.with_suffix("") / "depth", fields[0])))
    return frames


def dl3dv(file, depths):
    """Reads the frames of a transforms.json and, like the paper's authors, ignores distortion."""
    shared, frames = json.loads(file.read_text()), []
    for i, own in enumerate(shared["frames"]):
        fields = {**shared, **own}
        if fields.get("is_fisheye") or "FISHEYE" in fields.get("camera_model", ""):
            raise ValueError(f"{file}: frames[{i}]: found a fisheye lens, expected one that is almost a pinhole")
        if lacking := [key for key in ("file_path", "transform_matrix", "w", "h", "fl_x") if key not in fields]:
            raise ValueError(f"{file}: frames[{i}]: found no {', '.join(lacking)}")
        w, h = fields["w"], fields["h"]
        lens = np.array((fields["fl_x"] / w, fields.get("fl_y", fields["fl_x"]) / h, fields.get("cx", w / 2) / w, fields.get("cy", h / 2) / h))
        path = Path(fields["file_path"])
        places = [file.parent / name for name in ("images_4", "images_2", "images_8", "images")]
        photo = find_photo(places, path.name) or find_photo([file.parent], path)
        # OpenGL's axes: y up, z backward.
        pose = np.array(fields["transform_matrix"], dtype=np.float64).reshape(4, 4) * (1, -1, -1, 1)
        frames.append(Frame(photo, lens, pose, (depths or file.parent / "depth", path.stem)))
    return frames


def read_depth(folder, name):
    """Returns [height, width] z in camera units from NAME.npy or a file of `zipsplat depth`."""
    place = folder / f"{name}.npy"
    if not place.is_file() and (folder / DEPTHS).is_file():
        with safe_open(folder / DEPTHS, "np") as file:
            names = json.loads(file.metadata()["zipsplat.photos"])
            if name not in names:
                raise ValueError(f"{folder / DEPTHS}: found no depth of {name}, expected one of {', '.join(names[:3])}..")
            return file.get_slice("depth")[names.index(name)]
    return np.load(place)


def scenes_of(kind, folder):
    """Returns a reader, {scene name: camera file} and a description of the expected files."""
    if kind == "re10k":
        files = {path.stem: path for path in folder.glob("*.txt") if path.open("rb").read(4) == b"http"}
        return re10k, files, "camera files NAME.txt that begin with an address"
    files = {}
    for path in sorted((*folder.glob("*/transforms.json"), *folder.glob("*/nerfstudio/transforms.json"))):
        scene = path.parent.parent if path.parent.name == "nerfstudio" else path.parent
        files.setdefault(scene.name, path)
    return dl3dv, files, "folders with a transforms.json, directly or in nerfstudio/"


class Captures:
    """An endless stream of records (`data.record`) that alternates between data sets.

    `sources` are (`re10k` or `dl3dv`, folder, folder of depths or None). Depth (0: unknown) is in
    DEPTHS/SCENE/, by default in `depth` next to the photos. Half of a record's views are farthest
    points of a random run of frames, the others random ones of it. `gap` bounds the run's length.
    The unit is the median depth. Unreadable scenes are reported and skipped.
    """

    def __init__(self, sources, record, gap, seed, count=None, unseen=False):
        self.record, self.gap, self.seed, self.count = record, gap, seed, count
        self.views, self.height, self.width = record["depths"].shape
        self.next = 0
        self.readers = ThreadPoolExecutor(READERS)
        self.sources = [self.scenes(*source, unseen) for source in sources]

    @staticmethod
    def scenes(kind, folder, depths, unseen):
        read, files, expected = scenes_of(kind, folder)
        if not files:
            raise SystemExit(f"{folder}: found no scene of {kind}, expected {expected}")
        names = sorted(files)
        digests = {name: hashlib.blake2b(name.encode()).digest() for name in names}
        kept = [name for name in names if digests[name][0] < 256 // UNSEEN] or [min(names, key=digests.get)]
        if unseen and kept == names:
            print(f"{folder}: found only {', '.join(names)}, for training and validation", file=sys.stderr, flush=True)
        chosen = kept if unseen else [name for name in names if name not in kept] or names
        return [(name, read, files[name], depths and depths / name) for name in chosen]

    def read_into(self, buffer):
        """Fills a byte array with records; returns their number."""
        rows = buffer.view(self.record)
        count = len(rows) if self.count is None else min(len(rows), self.count - self.next)
        for row in rows[:count]:
            self.fill(row)
        return count

    def fill(self, row):
        """Fills one record; its number seeds the choice of scene."""
        rng = np.random.default_rng((self.seed, self.next))
        source = self.sources[self.next % len(self.sources)]
        row["seed"] = self.seed + self.next
        self.next += 1
        while True:
            name, read, file, depths = scene = source[rng.integers(len(source))]
            try:
                return self.draw(row, read(file, depths), rng)
            except (OSError, ValueError) as error:
                source.remove(scene)
                print(f"left out {name}: {error}", file=sys.stderr, flush=True)
                if not source:
                    raise RuntimeError(f"found no scene that can be read, the last of them {name}: {error}") from error

    def draw(self, row, frames, rng):
        found = [frame for frame in frames if frame.photo is not None]
        if len(found) < self.views:
            raise ValueError(f"found {len(found)} frames with photos of {len(frames)}, expected {self.views} at least")
        length = min(max(int(rng.integers(self.gap[0], self.gap[1] + 1)), self.views), len(found))
        first = rng.integers(len(found) - length + 1)
        stretch = found[first : first + length]
        chosen = farthest(np.array([frame.pose[:3, 3] for frame in stretch]), rng.integers(length), (self.views + 1) // 2)
        others = rng.permutation([i for i in range(length) if i not in chosen])[: self.views - len(chosen)]
        views = [stretch[i] for i in (*chosen, *others)]
        read = list(self.readers.map(self.view, views))
        depths = np.stack([depth for _, _, depth in read])
        if not (depths > 0).any():
            raise ValueError(f"found no depth above 0, such as of {views[0].depth[1]}")
        unit = np.median(depths[depths > 0])
        row["family"] = row["path"] = row["overlap"] = 0
        row["colors"] = np.stack([picture for picture, _, _ in read])
        row["intrinsics"] = np.stack([lens for _, lens, _ in read])
        row["depths"] = depths / unit
        for pose, frame in zip(row["poses"], views):
            pose[:] = frame.pose[:3]
            pose[:, 3] /= unit

    def view(self, frame):
        """Returns the center crop at the record's size, its lens in pixels, and its depth."""
        photo = Image.open(frame.photo).convert("RGB")
        sides, size = np.array(photo.size), np.array((self.width, self.height))
        scale = (size / sides).max()
        corner = (sides - size / scale) / 2
        picture = photo.resize(tuple(size.tolist()), Image.LANCZOS, box=(*corner, *(corner + size / scale)))
        lens = frame.lens * np.tile(sides, 2)
        lens[2:] -= corner
        depth = read_depth(*frame.depth)
        if depth.ndim != 2 or abs(depth.shape[1] * sides[1] / (depth.shape[0] * sides[0]) - 1) > 0.05:
            raise ValueError(f"{frame.depth[1]}: found depth {list(depth.shape)}, expected the shape of its photo, {sides[1]}x{sides[0]}")
        x, y = (
            ((np.arange(size[axis]) + 0.5) / scale + corner[axis]) * depth.shape[1 - axis] / sides[axis] for axis in (0, 1)
        )
        depth = depth[y.astype(int)[:, None], x.astype(int)]
        return np.asarray(picture), lens * scale, np.where(np.isfinite(depth) & (depth > 0), depth, 0)

    def close(self):
        self.readers.shutdown(wait=False, cancel_futures=True)


def farthest(positions, first, count):
    """Farthest-point sampling of [N, 3] from `first`: `count` indices."""
    chosen = [int(first)]
    distance = np.full(len(positions), np.inf)
    while len(chosen) < count:
        distance = np.minimum(distance, np.linalg.norm(positions - positions[chosen[-1]], axis=1))
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return chosen

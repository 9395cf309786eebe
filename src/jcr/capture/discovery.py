"""Discovery of a capture's images and of the documents that may hold its gripper poses."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image

from jcr.capture.documents import Table, read_record_tables, read_tables
from jcr.capture.images import IMAGE_FORMATS
from jcr.capture.pairing import NEARLY, Pairing, natural, pair, plain_name
from jcr.capture.readings import pose_columns, words_of
from jcr.errors import InputError, count_of, first_few
from jcr.files import IMAGES, capture_file, path_inside

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
OTHER_IMAGES = {
    ".heic": "HEIC",
    ".heif": "HEIC",
    **dict.fromkeys((".dng", ".cr2", ".nef", ".arw", ".raw"), "raw"),
}
"""Endings of pictures that are not read, and the names of their formats."""
NOT_SCENE = {
    "mask", "masks", "depth", "depths", "seg", "segmentation", "label", "labels", "disparity", "confidence",
}  # fmt: skip
"""Words in names of files and folders with images that do not show the scene in colour."""
USUAL_FOLDERS = ("images", "image", "rgb", "color", "colour", "img", "imgs")
"""Names of folders with the images of a capture, the first ones preferred."""
IGNORED = {
    ".pyc", ".py", ".ipynb", ".md", ".pdf", ".zip", ".gz", ".ply", ".pcd", ".stl", ".urdf", ".mp4", ".avi", ".svg",
}  # fmt: skip
"""Endings of files that hold no poses."""
DEEPEST = 4
"""Largest number of folders below the capture's in which files are found."""
MOST_FILES, MOST_BYTES = 200, 20_000_000
"""Largest number and size of the documents that are searched for poses."""


@dataclass(frozen=True, kw_only=True)
class Discovery:
    """Images of a capture, tables that may hold their poses with the pairing of each, and what was left out."""

    images: tuple[str, ...]
    """Paths relative to the folder, in natural order."""
    tables: tuple[tuple[Table, Pairing], ...]
    documents: tuple[Path, ...]
    refused: tuple[tuple[Path, InputError], ...]
    """Files that cannot be read, or whose poses differ in number from the images, with the error of each."""
    notes: tuple[str, ...]


def discover(folder: Path, poses: Path | None = None) -> Discovery:
    """Find the images of a folder and all tables with a row for nearly every image.

    `poses` is the only file of poses that is read, or a folder with one file for each image; None: all documents of the
    folder, or beside it if there are none. Raises InputError if the folder has no images.
    """
    if poses is not None and not poses.exists():
        raise InputError(f"{poses}: no such file or folder; correct --poses")
    images, notes = find_images(folder)
    listed, linked = _files_of(folder)
    files, large = _limited(listed)
    documents, outside = ([poses], []) if poses is not None else _own(folder, files)
    tables, refused, others = _tables_of(documents, images)
    refused += outside
    if not tables and not refused and poses is None:
        parent = folder.resolve().parent
        beside, _ = _limited(sorted(one for one in parent.iterdir() if one.is_file()))
        tables = _tables_of(_own(parent, beside)[0], images)[0]
    refused += others
    if large and poses is None:
        names = first_few([one.name for one in large])
        notes += (
            f"not searched for poses, over {MOST_BYTES // 1_000_000} MB in all: {names}; name one with --poses",
        )
    if linked:
        notes += (f"{_names_of(linked, folder)}; copy them, or name their poses with --poses",)
    return Discovery(
        images=images, tables=tuple(tables), documents=tuple(documents), refused=tuple(refused), notes=notes
    )


def _own(folder: Path, files: Sequence[Path]) -> tuple[list[Path], list[tuple[Path, InputError]]]:
    """Return the files of a folder without links that lead out of it, and an error for each of those."""
    own, errors = list[Path](), list[tuple[Path, InputError]]()
    for file in files:
        try:
            own.append(capture_file(folder, str(file.relative_to(folder)), str(folder)))
        except InputError as error:
            errors.append((file, error))
    return own, errors


def find_images(folder: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the images of a folder or of one of its subfolders, relative to it in natural order, and notes.

    Hidden files, masks and depth images are left out, and images of another size than most. Of several folders with
    images, the one with a usual name, else the one with most images, is taken, which a note states. Raises InputError
    if there are none.
    """
    found, others = dict[Path, list[Path]](), Counter[str]()
    files, linked = _files_of(folder)
    for file in files:
        if (suffix := file.suffix.lower()) in OTHER_IMAGES:
            others[OTHER_IMAGES[suffix]] += 1
        relative = file.relative_to(folder)
        words = {word for part in (*relative.parts[:-1], relative.stem) for word in words_of(part)}
        if suffix in IMAGE_SUFFIXES and not words & NOT_SCENE:
            found.setdefault(file.parent, []).append(file)
    if not found:
        what = "put them there"
        if others:
            what = f"it holds {first_few(sorted(others))} pictures: convert them to PNG or JPEG"
        elif linked:
            what = f"{_names_of(linked, folder)}: copy them, or call the link {IMAGES}"
        raise InputError(f"{folder}: holds no images ({', '.join(IMAGE_SUFFIXES)}); {what}")
    if max(map(len, found.values())) == 1 and len(found) > 2:  # a folder for each image
        taken, chosen, notes = [one for files in found.values() for one in files], folder, list[str]()
    else:
        chosen = max(found, key=lambda one: (_preference(one, folder, found), -len(one.parts)))
        taken, notes = found[chosen], list[str]()
    rest = sorted(str(one.relative_to(folder)) for one in found if one != chosen and len(found[one]) >= 3)
    if rest and chosen in found:
        notes.append(f"images taken from {chosen.relative_to(folder)}/, not from {first_few(rest)}")
    sizes = {file: _size(file) for file in taken}
    usual = Counter(size for size in sizes.values() if size is not None).most_common(1)
    odd = [file for file in taken if usual and sizes[file] not in (None, usual[0][0])]
    if odd and len(odd) < len(taken) / 2:
        names = first_few([str(file.relative_to(folder)) for file in odd])
        notes.append(
            f"left out: {count_of(len(odd), 'image')} of another size than {usual[0][0][0]}x{usual[0][0][1]}: {names}"
        )
        taken = [file for file in taken if file not in odd]
    return tuple(sorted((str(file.relative_to(folder)) for file in taken), key=natural)), tuple(notes)


def _preference(one: Path, folder: Path, found: dict[Path, list[Path]]) -> tuple[bool, int, int]:
    """Return the sort key of a folder with images: many enough, usual name, number of images."""
    most = max(map(len, found.values()))
    name = one.name.lower() if one != folder else ""
    rank = len(USUAL_FOLDERS) - USUAL_FOLDERS.index(name) if name in USUAL_FOLDERS else 0
    return len(found[one]) >= min(3, most), rank, len(found[one])


def _size(file: Path) -> tuple[int, int] | None:
    """Return the size of an image file by its header; None for a damaged one."""
    try:
        with Image.open(file, formats=IMAGE_FORMATS) as opened:
            return opened.size
    except Exception:  # decoders raise errors of many types for a damaged file
        return None


def _files_of(folder: Path, depth: int = 0) -> tuple[list[Path], list[Path]]:
    """Return the files of a folder and its subfolders, nearest first, and the linked folders that are left out.

    Hidden entries are not listed. A link may lead out of the folder or back into it; only one called images is followed.
    """
    entries = sorted(one for one in folder.iterdir() if not one.name.startswith((".", "__")))
    files, linked = [one for one in entries if one.is_file()], list[Path]()
    for one in (entry for entry in entries if entry.is_dir()) if depth < DEEPEST else ():
        is_left = one.is_symlink() and (depth > 0 or one.name != IMAGES)
        more, left = ([], [one]) if is_left else _files_of(one, depth + 1)
        files, linked = files + more, linked + left
    return files, linked


def _names_of(linked: Sequence[Path], folder: Path) -> str:
    """Return words for linked folders that were left out."""
    return f"linked folders are left out: {first_few([str(one.relative_to(folder)) for one in linked])}"


def _limited(files: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Return the files that may hold poses by their endings, up to the limit of bytes, and those above the limit."""
    taken, left, total = list[Path](), list[Path](), 0
    for file in files:
        if file.suffix.lower() not in {*IMAGE_SUFFIXES, *IGNORED, *OTHER_IMAGES}:
            total += file.stat().st_size
            (taken if total <= MOST_BYTES else left).append(file)
    return taken, left


def _tables_of(
    documents: Sequence[Path], images: Sequence[str]
) -> tuple[list[tuple[Table, Pairing]], list[tuple[Path, InputError]], list[tuple[Path, InputError]]]:
    """Return the tables of documents with a row for nearly every image, each paired with the images, and errors.

    The errors are those of files that cannot be read, and of files with too few or too many poses. Files of which there
    is one for each image are read as one table; so are those that an index lists beside images.
    """
    found, grouped = list[tuple[Table, Pairing]](), set[Path]()
    refused, others = list[tuple[Path, InputError]](), list[tuple[Path, InputError]]()

    def add(tables: Sequence[Table]) -> None:
        for table in tables:
            paired = pair(table, images)
            off = abs(len(table.rows) - len(images))
            if paired.is_paired or off <= max(2, len(images) // 4):
                found.append((table, paired))
            elif pose_columns(table, paired.skipped):
                poses, of = count_of(len(table.rows), "pose"), f"({images[0]} … {images[-1]})"
                what = f"{poses} for {count_of(len(images), 'image')} {of}"
                remedy = "give one for each image, or add a column with the images' names"
                others.append((table.file, InputError(f"{table.file}: {what}; {remedy}")))

    for files in _groups([one for one in documents if one.is_file()], images):
        grouped |= set(files)
        try:
            add(read_record_tables(files))
        except InputError as error:
            refused.append((files[0], error))
    for folder in (one for one in documents if one.is_dir()):
        files = sorted((one for one in folder.iterdir() if one.is_file()), key=lambda one: natural(one.name))
        add(read_record_tables(files))
    for file in [one for one in documents if one.is_file() and one not in grouped][:MOST_FILES]:
        try:
            tables = read_tables(file)
        except InputError as error:
            refused.append((file, error))
            continue
        add(tables)
        for table in tables:
            add(_indexed(table, images))
    return found, refused, others


def _groups(documents: Sequence[Path], images: Sequence[str]) -> list[list[Path]]:
    """Return groups of documents of one folder and ending that have the images' names, or nearly as many numbers."""
    names = {plain_name(image) for image in images}
    groups = dict[tuple[Path, str, str], list[Path]]()
    for file in documents:
        is_like = plain_name(file.stem) in names
        template = "=" if is_like else re.sub(r"\d+", "#", file.stem)
        groups.setdefault((file.parent, file.suffix.lower(), template), []).append(file)
    numbered = max(3, NEARLY * len(images))
    return [
        sorted(files, key=lambda one: natural(one.name))
        for (_, _, template), files in groups.items()
        if len(files) >= (3 if template == "=" else numbered)
    ]


def _indexed(table: Table, images: Sequence[str]) -> list[Table]:
    """Return the tables of the documents that a table lists beside the names of images, with these names as keys."""
    columns = [[row[k] for row in table.rows] for k in range(len(table.columns))]
    texts = [[cell for cell in cells if isinstance(cell, str)] for cells in columns]
    whole = [cells for cells in texts if len(cells) == len(table.rows)]
    names = {plain_name(image) for image in images}
    endings = [{Path(cell).suffix.lower() for cell in cells} for cells in whole]
    of_images = [cells for cells, own in zip(whole, endings, strict=True) if own and own <= {*IMAGE_SUFFIXES}]
    if not of_images or len({plain_name(cell) for cell in of_images[0]} & names) < NEARLY * len(names):
        return []
    for cells in whole:
        if cells is of_images[0] or len(set(cells)) < len(cells):
            continue
        try:
            if not all(path_inside(table.file.parent, cell, "").is_file() for cell in cells):
                continue
            files = [table.file.parent / cell for cell in cells]
            made = read_record_tables(files)
        except InputError:
            continue
        return [replace(one, keys=tuple(of_images[0])) for one in made if len(one.rows) == len(files)]
    return []

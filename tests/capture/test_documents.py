"""Documents: each syntax with a known answer, hostile files and real files."""

import io
import json
import pickle
import struct
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from jcr.capture.documents import Table, read_content, read_record_tables, read_tables
from jcr.errors import InputError
from places import SHARED
from refusal import refused

INPUTS = SHARED / "inputs"
SIX = (None,) * 6
MATRIX = tuple(f"{i}.{j}" for i in range(4) for j in range(4))
EYE = (1.0, 0.0, 0.0, 5.0, 0.0, 1.0, 0.0, 6.0, 0.0, 0.0, 1.0, 7.0, 0.0, 0.0, 0.0, 1.0)
BLOCK = "1 0 0 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n"
ROBTARGET = "CONST robtarget p{}:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
FANUC = "P[{0}]{{\n  GP1:\n UF : 0, UT : 1,  CONFIG : 'N U T, 0, 0',\n X = 1.5 mm, Y = {0} mm,\n W = -2 deg\n}};\n"
TEXTS = {
    "csv": ("image,x,y\na.png,1,2\nb.png,3,4\n", ("image", "x", "y"), ("a.png", 1.0, 2.0), None),
    "cells that are wrong or missing": ("image,x,y\na.png,1,\nb.png,ERR,ERR\nc.png\n,,\n", ("image", "x", "y"),
                                        ("a.png", 1.0, None), None),
    "decimal commas": ("x;y;z\n0,5;1,5;2\n", ("x", "y", "z"), (0.5, 1.5, 2.0), None),
    "decimal commas, tabs": ("0,5\t1,5\t-2,5\n", (None,) * 3, (0.5, 1.5, -2.5), None),
    "separator stated": ("sep=;\n\"X[mm]\";roll (deg)\n1,5;2\n", ("X[mm]", "roll (deg)"), (1.5, 2.0), None),
    "comment as header": ("# a\n# timestamp tx ty\n1.5 .5 +1e-3\n", ("timestamp", "tx", "ty"), (1.5, 0.5, 0.001), None),
    "nanoseconds": ("%time,field.x\n1700000000123456789,1\n", ("time", "field.x"), ("1700000000123456789", 1.0), None),
    "date and time": ("2023-11-14 22:13:21.5 1 2\n", (None,) * 3, ("2023-11-14 22:13:21.5", 1.0, 2.0), None),
    "mixed separators": ("a.png, 0.5 1 2\nb.png, 1 2 3\n", (None,) * 4, ("a.png", 0.5, 1.0, 2.0), None),
    "units": ("298.8mm 12.5° 3\n1 mm 2° 3\n", ("[mm]", "[°]", None), (298.8, 12.5, 3.0), None),
    "numbered columns": (",0,1,2\n0,5,6,7\n", (None,) * 4, (0.0, 5.0, 6.0, 7.0), None),
    "names between rows": ("[INFO] [16.5]: x\n1 2 3 4 5 6\nSave: a-1.png\n7 2 3 4 5 6\nSave: a-2.png\n", SIX,
                           (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), ("a-1.png", "a-2.png")),
    "wrapped": ("[ 1. 2. 3. 4. 5.\n  6.]\n[ 2. 2. 3. 4. 5.\n  6.]\n", SIX, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None),
    "KUKA": ("DECL E6POS XP1={X 1,Y 2.5,A -3}\nDECL E6POS XP2={X 1,Y 2,A 3}\n", ("X", "Y", "A"), (1.0, 2.5, -3.0),
             ("XP1", "XP2")),
    "Fanuc": (FANUC.format(1) + FANUC.format(2), ("UF", "UT", "CONFIG", "X [mm]", "Y [mm]", "W [deg]"),
              (0.0, 1.0, "N U T, 0, 0", 1.5, 1.0, -2.0), ("P[1]", "P[2]")),
    "lines of named numbers": ("X = 1 mm, Y = 2 mm\nW = 3 deg\n\nX = 4 mm, Y = 2 mm\nW = 3 deg\n",
                               ("X [mm]", "Y [mm]", "W [deg]"), (1.0, 2.0, 3.0), None),
    "script": ("movej(p[1,2,3,4,5,6], a=1.2, v=0.25)\nmovel(q[1,2])", SIX, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None),
    "Python": ("x = 1\nposes = [[1,2,3,4,5,6],\n [2,2,3,4,5,6], # second\n [3,2,3,4,5,6],\n]", SIX,
               (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None),
    "C": ("double p[3][6] = {\n {1,2,3,4,5,6},\n {2,2,3,4,5,6},\n {3,2,3,4,5,6},\n};", SIX,
          (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None),
    "MATLAB": ("A = [1 2 3 4 5 6; 2 2 3 4 5 6\n 3 2 3 4 5 6];", SIX, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), None),
    "arrays": ("T0 = np.array([[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]])\n" * 2, MATRIX, EYE, None),
    "Pose": ("Pose(position=Point(x=1, y=2), q=Quat(x=3, w=4))", ("position.x", "position.y", "q.x", "q.w"),
             (1.0, 2.0, 3.0, 4.0), None),
    "names before brackets": ("a.png: (1, 2)\nb.png: (3, 4)\n", (None, None), (1.0, 2.0), ("a.png", "b.png")),
    "brackets in cells": ('t,pos\n1,"[0.5, 2]"\n2,"[3, 4]"\n', ("t", "pos.0", "pos.1"), (1.0, 0.5, 2.0), None),
    "robtargets": (ROBTARGET.format(10) + ROBTARGET.format(20),
                   tuple(f"{i}.{j}" for i, n in enumerate((3, 4, 4, 6)) for j in range(n)),
                   (1.0, 2.0, 3.0, 1.0, *[0.0] * 7, *[9e9] * 6), ("p10", "p20")),
    "matrices": (BLOCK + BLOCK, MATRIX, EYE, None),
    "matrices apart": (BLOCK + "\n" + BLOCK, MATRIX, EYE, None),
    "matrices with names": ("image 1:\n" + BLOCK + "image 2:\n" + BLOCK, MATRIX, EYE, ("image 1", "image 2")),
    "matrices with a count": ("2\n0\n" + BLOCK + "1\n" + BLOCK, MATRIX, EYE, None),
}  # fmt: skip
NESTED = {
    "a.json": ('{"n":1,"s":[{"p":[1,"0.5"],"t":"20_1"},{"p":[3,4]},{"p":[5,6],"t":"20_3"}]}',
               ("p.0", "p.1", "t"), (1.0, 0.5, "20_1"), None),
    "b.json": ('{"images":["a","b","c"],"poses":[[1,2],[3,4],[5,6]]}', ("images", "poses.0", "poses.1"),
               ("a", 1.0, 2.0), None),
    "c.json": ('{"a.png":{"x":1},"b.png":{"x":true},"c.png":{"x":null}}', ("x",), (1.0,), ("a.png", "b.png", "c.png")),
    "i.json": ('{"T":[' + ",".join(['{"type_id":"opencv-matrix","rows":2,"cols":2,"data":[1,2,3,4]}'] * 3) + "]}",
               ("0.0", "0.1", "1.0", "1.1"), (1.0, 2.0, 3.0, 4.0), None),
    "d.jsonl": ('{"t":1700000000123456789}\n' * 3, ("t",), ("1700000000123456789",), None),
    "e.yaml": ("- {p: {X: 1.5}}\n- {p: {X: .nan}}\n- {p: {X: 22:13:21}}\n", ("p.X",), (1.5,), None),
    "f.txt": ("header:\n  seq: 1\n---\nheader:\n  seq: 2\n---\nheader:\n  seq: 3\n---\n", ("header.seq",), (1.0,), None),
    "g.yml": ("%YAML:1.0\n---\nn: 3\n" + "".join(
        f"T1_{k}: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: [ 1., 2.,\n       3., {k}. ]\n"
        for k in range(3)), ("0.0", "0.1", "1.0", "1.1"), (1.0, 2.0, 3.0, 0.0), ("T1_0", "T1_1", "T1_2")),
    "h.xml": ('<?xml version="1.0"?>\n<opencv_storage><p>' + '<_ type_id="opencv-matrix"><rows>3</rows><cols>1</cols>'
              "<dt>d</dt><data>1. 2.\n 3.</data></_>" * 5 + "</p></opencv_storage>",
              ("0", "1", "2"), (1.0, 2.0, 3.0), None),
}  # fmt: skip


def npy(array: np.ndarray) -> bytes:
    """Return an array as the bytes of a .npy file."""
    np.save(stream := io.BytesIO(), array)
    return stream.getvalue()


def npz(method: int, *sizes: int) -> bytes:
    """Return the bytes of a .npz file with an array of zeros of each size."""
    with zipfile.ZipFile(stream := io.BytesIO(), "w", method) as archive:
        for k, size in enumerate(sizes):
            archive.writestr(f"{k}.npy", npy(np.zeros((size, 1), np.int8)))
    return stream.getvalue()


HOSTILE = {
    "aliases.yaml": b"- &a [1, 2]\n- *a\n", "itself.yaml": b"&a [*a]", "merge.yaml": b"a: {<<: {b: 1}}",
    "object.yaml": b"!!python/object/apply:os.system ['true']", "twice.yaml": b"a: 1\na: 2",
    "twice.json": b'{"a":1,"a":2}',
    "deep.json": b"[" * 100_000, "deep.yaml": b"[" * 100_000, "cut.json": b'{"a": [1', "nul.csv": b"1,2\n\0\1\2",
    "entity.xml": b'<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>',
    "other.xml": b"<root><a>1</a></root>",
    "deep.xml": b"<opencv_storage>" * 100_000, "many.json": b"[" + b"1," * 1_000_001 + b"1]",
    "large.txt": b"1 2\n" * 5_000_001,
    "many.txt": b"1 2\n" * 600_000,
    "pickle.dat": pickle.dumps([1.0]), "a.pkl": b"(lp0\n.", "book.bin": b"\xd0\xcf\x11\xe0" + bytes(99),
    "data.h5": b"\x89HDF\r\n\x1a\n" + bytes(99), "new.mat": b"MATLAB 7.3 MAT-file" + bytes(99),
    "cut.mat": b"MATLAB 5.0" + bytes(90),
    "cut.npy": b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,), }" + b" " * 50,
    "bad.npz": b"PK\x03\x04" + bytes(50),
    "bracket.txt": b"[" + b"1;" * 1_000_000 + b"]", "index.txt": b"a" + b"[1]" * 600_000 + b" = 1",
    "values.jsonl": b"1\n" * 1_000_001,
    "values.xml": b"<opencv_storage><a>" + b"1 " * 1_000_000 + b"</a></opencv_storage>",
    "name.json": b'[' + b",".join([b'{"%s":[%s]}' % (b"k" * 10_000, b",".join([b"1"] * 1000))] * 3) + b"]",
    "place.json": b'{"%s":[[{}],[{}],[{}]]}' % (b"k" * 10_000),
    "name.txt": b"k" * 10_000 + b"=(1,2) x=(3,4)\n",
    "bz2.npz": npz(zipfile.ZIP_BZIP2, 6), "members.npz": npz(zipfile.ZIP_DEFLATED, *[900_000] * 3),
    "characters.npy": npy(np.array(["abcd"] * 6))[:-96] + b"\xff" * 96,
}  # fmt: skip
HARMLESS = ("", "\n\n", "(" * 50_000, "9" * 1_000_000 + " 1 2", "1." + "1" * 1_000_000, '"' * 50_000, "(a" * 50_000,
            "'(,)" * 20_000, "a=" * 50_000, "1 " * 100_000, "- " * 50_000, "[1 2\n" * 20_000, "x" * 1_000_000,
            ", ,\n1 , 2\n", "".join(f"{'x' * 100_000}{k}\n1 2 3\n" for k in range(6)), "a:" + "\n" * 200_000,
            "( " + " ".join(f"w{k}" for k in range(100_000)) + " 1mm" * 100_000 + ")",
            "".join(f"a{k}=1\n" for k in range(40_000)),
            "".join("( " * 4900 + f"\n{','.join('1' * k)}" * 6 + "\n" for k in range(3, 17)))  # fmt: skip


def tables_of(folder: Path, text: str | bytes, name: str = "a.txt") -> tuple[Table, ...]:
    """Write a file and read its tables."""
    (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_tables(folder / name)


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text(case: str, encoding: str, tmp_path: Path) -> None:
    text, columns, row, keys = TEXTS[case]
    for lines in (text, text.replace("\n", "\r\n")):
        found = [one for one in tables_of(tmp_path, lines.encode(encoding)) if one.columns == columns]
        assert len(found) == 1 and found[0].rows[0] == row and found[0].keys == keys
        assert all(len(one) == len(columns) for one in found[0].rows)


def test_words_state_the_function_and_the_title(tmp_path: Path) -> None:
    script, joints = tables_of(tmp_path, "# Poses in MM\nmovej(p[1,2,3,4,5,6])\nmovej([1,2,3,4,5,6])\n")
    assert script.words == "movej p poses in mm" and joints.words == "movej poses in mm"
    assert tables_of(tmp_path, ROBTARGET.format(10))[0].words.startswith("const robtarget")


def test_wrong_rows_stay(tmp_path: Path) -> None:
    (table,) = tables_of(tmp_path, TEXTS["cells that are wrong or missing"][0])
    assert table.rows[1:] == (("b.png", "ERR", "ERR"),)


def test_sections_are_tables_beside_the_whole(tmp_path: Path) -> None:
    rows = "1 2 3 4 5 6\n" * 5
    tables = tables_of(tmp_path, f"robot\n{rows}camera\n{rows}")
    assert [(len(one.rows), one.words, one.place) for one in tables] == [
        (10, "robot camera", ""), (5, "robot", "line 2"), (5, "camera", "line 8")]  # fmt: skip


@pytest.mark.parametrize("name", NESTED)
def test_nested(name: str, tmp_path: Path) -> None:
    text, columns, row, keys = NESTED[name]
    found = [one for one in tables_of(tmp_path, text, name) if one.columns == columns]
    assert len(found) == 1 and found[0].rows[0] == row and found[0].keys == keys and len(found[0].rows) >= 3


def test_content_is_plain(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "a: yes\nb: [1, '1', null, true, 0123456789123456]\nd: {rows: 1, cols: 2, data: [1, 2]}"
    )
    assert read_content(tmp_path / "a.yaml") == {
        "a": "yes", "b": [1.0, "1", None, True, "0123456789123456"], "d": [1.0, 2.0]}  # fmt: skip


def test_encodings(tmp_path: Path) -> None:
    assert tables_of(tmp_path, "位置,x\na,1\n".encode("gb18030"))[0].columns == ("位置", "x")
    assert tables_of(tmp_path, "Höhe,x\na,1\n".encode("latin-1"))[0].columns[1] == "x"
    assert tables_of(tmp_path, "1 12.5°\n".encode("latin-1"))[0].columns == (None, "[°]")


def test_arrays(tmp_path: Path) -> None:
    poses = np.random.default_rng(0).normal(size=(7, 4, 4))
    np.save(tmp_path / "a.npy", poses)
    (table,) = read_tables(tmp_path / "a.npy")
    assert table.columns == MATRIX and np.array_equal(np.array(table.rows), poses.reshape(7, 16))
    np.save(tmp_path / "a.npy", np.asfortranarray(np.moveaxis(poses, 0, -1)))
    assert read_tables(tmp_path / "a.npy")[0].rows == table.rows
    np.savez(tmp_path / "b.npz", R=poses[:, :3, :3], t=poses[:, :3, 3], id=np.arange(7))
    found = {one.place: one for one in read_tables(tmp_path / "b.npz")}
    assert found["t"].columns == (None,) * 3 and np.array_equal(np.array(found["t"].rows), poses[:, :3, 3])
    assert found[""].columns[:2] == ("R.0.0", "R.0.1")
    assert found[""].columns[9:] == ("t.0", "t.1", "t.2", "id.0")
    arrays = {"T": np.moveaxis(poses, 0, -1), "big": np.zeros((7, 3)), "note": "mm", "s": {"A": poses}}
    savemat(tmp_path / "c.mat", arrays, do_compression=True)
    assert {one.place: one for one in read_tables(tmp_path / "c.mat")}["T"].rows == table.rows
    savemat(tmp_path / "c.mat", {"s": {"A": poses}})
    with refused("a cell array or a struct; save a table with writetable"):
        read_tables(tmp_path / "c.mat")
    np.save(tmp_path / "a.npy", np.array([{}], object))
    with refused("pickle"):
        read_tables(tmp_path / "a.npy")
    for bomb, what in ((np.zeros(3_000_000), "20 MB"), (np.zeros(9_000_000, np.int8), "1,000,000 values")):
        savemat(tmp_path / "c.mat", {"A": bomb}, do_compression=True)
        with refused(what):
            read_tables(tmp_path / "c.mat")


def test_an_archive_unpacks_no_more_than_it_states(tmp_path: Path) -> None:
    data = bytearray(npz(zipfile.ZIP_DEFLATED, 200_000_000))
    struct.pack_into("<I", data, data.rfind(b"PK\x01\x02") + 24, 200)
    (tmp_path / "a.npz").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(InputError):
        read_tables(tmp_path / "a.npz")
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        tables_of(tmp_path, HOSTILE[name], name)
    assert len(str(caught.value)) < 250 + len(str(tmp_path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", HARMLESS, ids=range(len(HARMLESS)))
@pytest.mark.slow
def test_hostile_text_ends_soon(text: str, tmp_path: Path) -> None:
    begin = time.process_time()
    assert len(tables_of(tmp_path, text)) <= 64
    assert time.process_time() - begin < 5


def test_records(tmp_path: Path) -> None:
    for k, text in enumerate((BLOCK, BLOCK.replace("5", "8"), BLOCK)):
        (tmp_path / f"{k}.txt").write_text(text)
        (tmp_path / f"{k}.json").write_text(json.dumps({"pose": [k, 2, 3], **({"note": "a"} if k else {})}))
        np.save(tmp_path / f"{k}.npy", np.arange(16).reshape(4, 4) + k)
    (table,) = read_record_tables([tmp_path / f"{k}.txt" for k in range(3)])
    assert table.columns == MATRIX and table.rows[1][3] == 8 and table.keys == ("0", "1", "2")
    assert table.file == tmp_path
    (table,) = read_record_tables([tmp_path / f"{k}.json" for k in range(3)])
    assert table.columns == ("pose.0", "pose.1", "pose.2", "note") and table.rows[0] == (0.0, 2.0, 3.0, None)
    (table,) = read_record_tables([tmp_path / f"{k}.npy" for k in range(3)])
    assert table.columns == MATRIX and table.rows[2][0] == 2


@pytest.mark.skipif(not INPUTS.is_dir(), reason="needs the collection of people's files")
def test_real_files_are_read_or_refused() -> None:
    for file in sorted(one for one in INPUTS.rglob("*") if one.is_file()):
        try:
            assert all(isinstance(one, Table) for one in read_tables(file))
        except InputError as error:
            assert "\n" not in str(error)

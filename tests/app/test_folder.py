"""The folder of the app: no path leads out of it, no file is overwritten, no upload is of another
kind.
"""

import os
import socket
import struct
import sys
import threading
import zipfile

import pytest

from dem_jax.app.folder import LARGEST_STL, Folder, check_stl, clean_stem
from dem_jax.cli.main import main
from dem_jax.errors import RecordError


def binary_stl(facets=1):
    return bytes(80) + struct.pack("<I", facets) + bytes(50 * facets)


@pytest.mark.parametrize(
    "name",
    [
        "../secret.h5",
        "/etc/passwd",
        "a/../../secret",
        "a/b/c.toml",
        ".hidden",
        "",
        "a\\..\\b",
        "a\x00.h5",
        "x" * 90,
        "a/",
    ],
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    with pytest.raises(RecordError):
        Folder(tmp_path / "own").find_path(name)


def test_links_that_lead_out_of_the_folder_are_refused_and_not_listed(tmp_path):
    (tmp_path / "secret.h5").write_bytes(b"secret")
    folder = Folder(tmp_path / "own")
    os.symlink(tmp_path / "secret.h5", folder.root / "link.h5")
    os.symlink(tmp_path, folder.root / "products")
    for name in ("link.h5", "products/secret.h5"):
        with pytest.raises(RecordError, match="leads out of the folder"):
            folder.find_path(name)
    assert folder.list_results() == []


def test_two_servers_never_get_the_same_name(tmp_path):
    folders, found = [Folder(tmp_path), Folder(tmp_path)], []

    def reserve(folder):
        found.extend(folder.reserve_stem("nut", f"text of {id(folder)}") for _ in range(20))

    threads = [threading.Thread(target=reserve, args=(folder,)) for folder in folders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 40 == len(list(tmp_path.glob("nut*.toml")))


def test_a_name_is_free_for_the_results_too(tmp_path):
    (tmp_path / "nut.h5").write_bytes(b"")
    assert Folder(tmp_path).reserve_stem("nut", "text") == "nut-2"


def test_an_upload_is_stored_under_a_plain_free_name(tmp_path):
    folder = Folder(tmp_path)
    assert (
        folder.store_upload("products", "../../My part (1).STL", binary_stl())
        == "products/My-part-1.stl"
    )
    assert (
        folder.store_upload("products", "My part 1.stl", binary_stl(2))
        == "products/My-part-1-2.stl"
    )
    assert (tmp_path / "products/My-part-1.stl").read_bytes() == binary_stl()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("part.exe", binary_stl()),
        ("part.stl", b"MZ" + bytes(200)),
        ("part.stl", binary_stl()[:-1]),
        ("part.stl", b"solid <script>"),
        ("part.stl", b""),
    ],
)
def test_other_kinds_of_files_are_refused(name, content):
    with pytest.raises(RecordError):
        check_stl(name, content)


def test_too_large_an_upload_is_refused():
    facets = LARGEST_STL // 50
    check_stl("part.stl", b"solid x\nfacet normal 0 0 1")
    with pytest.raises(RecordError, match="up to 50 MB"):
        check_stl("part.stl", binary_stl(facets))


def test_a_scene_that_names_files_elsewhere_is_refused(tmp_path):
    folder = Folder(tmp_path)
    folder.check_references(
        {"base": "weigh-bucket", "product": "frozen-pea:thawing", "bucket": "buckets/a.toml"}
    )
    for tree in (
        {"product": "../a.toml"},
        {"weigh_bucket": {"stl": "/etc/part.stl"}},
        {"feed_bucket": {"flap_stl": ["a.stl", "../b.stl"]}},
        {"portion": {"product": [{"product": "../../x.toml:state"}]}},
    ):
        with pytest.raises(RecordError, match="leads out of the folder"):
            folder.check_references(tree)


def test_products_that_name_files_elsewhere_or_cannot_be_read_are_not_listed(tmp_path):
    folder = Folder(tmp_path / "own")
    (tmp_path / "secret.stl").write_bytes(binary_stl())
    products = folder.root / "products"
    products.mkdir()
    os.symlink(tmp_path / "secret.stl", products / "link.stl")
    for name, stl in (("a", "a.stl"), ("b", "../../secret.stl"), ("c", "link.stl")):
        (products / f"{name}.toml").write_text(f"[portion]\nstl = '{stl}'\n")
    (products / "d.toml").write_text("[portion")
    assert folder.list_products() == ["products/a.toml"]


def test_a_scene_is_taken_along_with_the_parts_that_it_names(tmp_path):
    folder = Folder(tmp_path)
    (tmp_path / "products").mkdir()
    (tmp_path / "products/a.stl").write_bytes(binary_stl())
    (tmp_path / "products/a.toml").write_text("[portion]\nstl = 'a.stl'\n")
    (tmp_path / "x.toml").write_text("base = 'weigh-bucket'\nproduct = 'products/a.toml'\n")
    names = ["x.toml", "products/a.toml", "products/a.stl"]
    assert folder.list_parts("x.toml") == names
    folder.zip_files(names, "x-scene.zip")
    with zipfile.ZipFile(tmp_path / "x-scene.zip") as found:
        assert found.namelist() == names


def test_any_text_makes_a_plain_name():
    assert clean_stem("Brötchen/..") == "Br-tchen"
    assert clean_stem("..") == clean_stem("") == "part"


def test_without_the_extra_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "nicegui", None)
    for name in [name for name in sys.modules if name.startswith("dem_jax.app.")]:
        monkeypatch.delitem(sys.modules, name)
    assert main(["app", str(tmp_path / "drops"), "--no-browser"]) == 2
    assert "pip install 'product-impact[app]'" in capsys.readouterr().err


def test_a_port_that_is_taken_is_refused(tmp_path, capsys):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["app", str(tmp_path), "--no-browser", "--port", str(port)]) == 2
    assert f"--port {port}: it is taken" in capsys.readouterr().err

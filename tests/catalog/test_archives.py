"""archive.yaml: what it names, and everything that can be wrong with it."""

import errno
import shutil

import pytest
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem
from seamosaic.catalog import archives
from seamosaic.catalog.filesystems import ObjectStoreError
from seamosaic.schemas.problems import InvalidInput


@pytest.fixture
def archive(tiny_mission, tmp_path):
    """An archive of two missions in a folder whose name looks like a pattern."""
    folder = tmp_path / "survey [2026]"
    for name in ("a", "b"):
        shutil.copytree(tiny_mission, folder / "missions" / name)
    (folder / "missions/empty").mkdir()
    write(folder, "")
    return folder


def write(folder, more):
    (folder / "archive.yaml").write_text(f"format: 1\nmissions: ['missions/*']\n{more}")


def test_missions_and_places(archive, tmp_path):
    opened = archives.open_archive(str(archive))
    assert archives.is_archive(str(archive))
    assert not archives.is_archive(str(archive / "missions/a"))
    assert opened.missions == tuple(str(archive / "missions" / name) for name in ("a", "b"))
    assert opened.products == str(archive / "products")
    write(archive, f"products: {tmp_path / 'elsewhere'}\n")
    assert archives.open_archive(str(archive)).products == str(tmp_path / "elsewhere")


def test_missions_of_an_object_store(archive):
    import fsspec

    memory = fsspec.filesystem("memory")
    for name in ("x", "y"):
        memory.pipe_file(f"/bucket/{name}/mission.yaml", b"")
    (archive / "archive.yaml").write_text("format: 1\nmissions: ['memory://bucket/*', 'missions/a']\n")
    found = archives.open_archive(str(archive)).missions
    assert found == (str(archive / "missions/a"), "memory:///bucket/x", "memory:///bucket/y")
    memory.pipe_file("/bucket/archive/archive.yaml", b"format: 1\nmissions: ['missions/*']\nproducts: products\n")
    memory.pipe_file("/bucket/archive/missions/z/mission.yaml", b"")
    opened = archives.open_archive("memory://bucket/archive/")
    assert opened.missions == ("memory:///bucket/archive/missions/z",)
    assert opened.products == "memory://bucket/archive/products"


def test_the_order_in_which_parameters_win(archive):
    (archive / "deep.yaml").write_text("grid: {cell_m: 0.1, max_interpolation_m: 2.0}\nmosaic: {colour: none}\n")
    write(
        archive,
        "parameters: deep.yaml\n"
        "overrides:\n"
        "  - {where: platform == 'Vortex', set: {grid.cell_m: 0.2, bathymetry.dense: false}}\n"
        "  - {where: images > 5, set: {grid.cell_m: 0.3}}\n",
    )
    opened = archives.open_archive(str(archive))

    def parameters(platform, images, **settings):
        found = archives.parameters_of(opened, {"platform": platform, "images": images}, settings)
        return found.grid.cell_m, found.bathymetry.dense, found.mosaic.colour

    assert parameters("Other", 1) == (0.1, True, "none")
    assert parameters("Vortex", 1) == (0.2, False, "none")
    assert parameters("Vortex", 10) == (0.3, False, "none")
    assert parameters("Vortex", 10, **{"grid.cell_m": "0.4", "mosaic.colour": "flatfield"}) == (0.4, False, "flatfield")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("concurency: 2\n", "concurrency"),
        ("concurrency: 0\n", "archive.yaml:3: concurrency"),
        ("select: platfrom == 'Vortex'\n", "unknown name platfrom"),
        ("select: cells > 3\n", "unknown name cells"),
        ("overrides: [{where: images > 3, set: {grid.cell: 1}}]\n", "cell_m"),
        ("overrides: [{where: images > 3, set: {}}]\n", "overrides"),
        ("parameters: none.yaml\n", "none.yaml"),
        ("keep_gb: -1\n", "keep_gb"),
    ],
)
def test_what_is_wrong_is_said(archive, more, said):
    write(archive, more)
    with pytest.raises(InvalidInput, match=said):
        archives.open_archive(str(archive))


def test_no_archive_and_no_missions(archive, tmp_path):
    with pytest.raises(InvalidInput, match=r"found nothing; expected the file of archive\.yaml"):
        archives.open_archive(str(tmp_path))
    shutil.rmtree(archive / "missions")
    with pytest.raises(InvalidInput, match=r"folders with a mission\.yaml that match missions"):
        archives.open_archive(str(archive))


def test_an_archive_is_the_same_by_any_way_that_leads_to_it(archive, tmp_path):
    elsewhere, link = tmp_path / "disk/c", tmp_path / "link"
    shutil.copytree(archive / "missions/a", elsewhere)
    (archive / "missions/c").symlink_to(elsewhere)
    (archive / "missions/d").symlink_to(archive / "missions/a")
    link.symlink_to(archive)
    missions = tuple(sorted(map(str, (archive / "missions/a", archive / "missions/b", elsewhere))))
    for url in (archive, link, archive / "missions/..", f"file://{link}", f"{link}/"):
        assert archives.is_archive(str(url))
        opened = archives.open_archive(str(url))
        assert (opened.url, opened.products, opened.missions) == (str(archive), f"{archive}/products", missions)


@pytest.mark.parametrize(
    "pattern", ["missions/*", "missions/[ab]", "*/?", "**", "missions/**", "./missions//*/", "{}/*"]
)
def test_patterns(archive, pattern):
    (archive / "archive.yaml").write_text(f"format: 1\nmissions: ['{pattern.format('missions')}']\n")
    assert [mission[-1] for mission in archives.open_archive(str(archive)).missions] == ["a", "b"]


def test_missions_that_cannot_be_listed_are_not_left_out(archive, monkeypatch):
    def failing(fs, path, **_):
        raise OSError(errno.EIO, "Input/output error", path)

    monkeypatch.setattr(LocalFileSystem, "ls", failing)
    with pytest.raises(OSError, match="Input/output"):
        archives.open_archive(str(archive))


def test_a_mission_that_may_not_be_read_is_one_nevertheless(archive, monkeypatch):
    info = LocalFileSystem.info

    def closed(fs, path, **more):
        if "missions/a/" in str(path):
            raise PermissionError(13, "Permission denied")
        return info(fs, path, **more)

    monkeypatch.setattr(LocalFileSystem, "info", closed)
    assert [mission[-1] for mission in archives.open_archive(str(archive)).missions] == ["a", "b"]


def test_a_store_that_does_not_answer_is_no_mistake_of_the_user(monkeypatch):
    def failing(*_, **__):
        raise OSError("503: slow down")

    for name in ("info", "cat_file"):
        monkeypatch.setattr(MemoryFileSystem, name, failing)
    for ask in (archives.is_archive, archives.open_archive):
        with pytest.raises(ObjectStoreError, match=r"503: slow down\. Check .* AWS_ENDPOINT_URL"):
            ask("memory://bucket/archive")

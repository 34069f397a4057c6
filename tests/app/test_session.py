"""Tabs and servers that share a folder."""

from dataclasses import replace

from dem_jax.app.folder import Folder
from dem_jax.app.jobs import JobRunner
from dem_jax.app.session import Session, Workspace
from dem_jax.scene import load_scene


def open_session(workspace, height):
    """A tab whose drop falls from a height (m). Its design is set as if nothing waited for it."""
    session = Session(workspace)
    session.__dict__["design"] = replace(session.design, changes={"drop.height": height})
    return session


def test_two_tabs_and_two_servers_on_one_folder_do_not_spoil_each_other(tmp_path):
    folders = Folder(tmp_path), Folder(tmp_path)
    servers = [Workspace(folder, JobRunner(folder.root)) for folder in folders]
    heights = (0.20, 0.21, 0.22, 0.23)
    sessions = [open_session(servers[k // 2], height) for k, height in enumerate(heights)]
    entered = [session.enter_drop() for session in sessions]
    assert len({name for _, name in entered}) == 4
    for height, (job, name) in zip(heights, entered, strict=True):
        scene = tmp_path / name.replace(".h5", ".toml")
        assert load_scene(scene).drop.height == height
        assert scene.name in job.argv and name in job.argv
    assert [session.design.changes["drop.height"] for session in sessions] == list(heights)
    assert [len(server.runner.jobs) for server in servers] == [2, 2]


def test_a_tab_keeps_its_own_choices(tmp_path):
    folder = Folder(tmp_path)
    workspace = Workspace(folder, JobRunner(folder.root))
    one, other = Session(workspace), Session(workspace)
    one.jobs["drop"], one.shown = one.enter_drop()
    one.compared.append(one.shown)
    assert (other.jobs, other.shown, other.compared) == ({}, "", [])

"""Where the package looks for the samples and weights that come with Sixfold: each place, in its order."""

import pytest

import sixfold
from sixfold import _shipped

SIGN = "test_targets_bop19.json"


def made(folder):
    folder.mkdir(parents=True)
    (folder / SIGN).write_text("[]")
    return folder


@pytest.fixture
def nowhere(tmp_path, monkeypatch):
    """A current folder, a package and a user's folder without samples."""
    here = tmp_path / "work/deep"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    monkeypatch.delenv("SIXFOLD_SHARE", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "user"))
    monkeypatch.setattr(_shipped, "__file__", str(tmp_path / "package/_shipped.py"))
    return tmp_path


def test_each_place_goes_before_the_next(nowhere, monkeypatch):
    user = made(nowhere / "user/sixfold/demo")
    assert sixfold.shipped("demo") == user
    package = made(nowhere / "package/share/demo")
    assert sixfold.shipped("demo") == package
    checkout = made(nowhere / "work/data/demo")
    assert sixfold.shipped("demo") == checkout
    variable = made(nowhere / "variable/demo")
    monkeypatch.setenv("SIXFOLD_SHARE", str(nowhere / "variable"))
    assert sixfold.shipped("demo") == variable


def test_a_folder_that_is_named_is_the_only_one(nowhere, monkeypatch):
    made(nowhere / "user/sixfold/demo")
    monkeypatch.setenv("SIXFOLD_SHARE", str(nowhere / "empty"))
    with pytest.raises(FileNotFoundError, match="empty") as error:
        sixfold.shipped("demo")
    assert "user" not in str(error.value)


def test_what_is_missing_names_all_places(nowhere):
    (nowhere / "work/data/demo").mkdir(parents=True)  # another folder of that name
    with pytest.raises(FileNotFoundError) as error:
        sixfold.shipped("demo")
    for place in ("work/deep/data/demo", "work/data/demo", "package/share/demo", "user/sixfold/demo"):
        assert str(nowhere / place) in str(error.value)


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="expected one of 'demo'.*found 'dmo'"):
        sixfold.shipped("dmo")

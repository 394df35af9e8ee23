"""The examples in the docstrings of the public names run and print what they say."""

import doctest
import inspect

import pytest

import seasonscapes as ss

PUBLIC = [name for name in ss.__all__ if not name.startswith("_")]
WITH_EXAMPLES = [name for name in PUBLIC if ">>>" in (inspect.getdoc(getattr(ss, name)) or "")]
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture(scope="module")
def workspace(tmp_path_factory, few_rays, coarse_viewer):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path_factory.mktemp("workspace")))
        yield


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples(name, workspace, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS)
    for test in doctest.DocTestFinder(recurse=False).find(getattr(ss, name), name, globs={}):
        runner.run(test, out=said.append)
    assert runner.tries > 0
    assert runner.failures == 0, "".join(said)


def test_every_public_name_has_an_example():
    # The two are a union of types and the base class of all errors.
    assert set(PUBLIC) - set(WITH_EXAMPLES) == {"SkyModel", "SeasonscapesError"}

"""A run knows what is fresh, resumes where it was killed, and says what it cannot do."""

import json

import pytest

from seasonscapes.errors import InputError
from seasonscapes.ledger import Stage, run_stages


class Chain:
    """Three stages that add letters to a file, and count how often they were made."""

    def __init__(self, folder, letters="abc"):
        self.folder, self.letters, self.made = folder, letters, []

    def stages(self):
        def stage(index: int) -> Stage:
            name, letter = ("one", "two", "three")[index], self.letters[index]
            before = ("one", "two", "three")[index - 1] if index else None

            def build(folder):
                self.made.append(name)
                text = (folder / f"{before}.txt").read_text() if before else ""
                (folder / f"{name}.txt").write_text(text + letter)
                return [folder / f"{name}.txt"]

            return Stage(name, {"letter": letter}, (before,) if before else (), build)

        return [stage(index) for index in range(3)]

    def run(self, **arguments):
        self.made.clear()
        run_stages(self.folder, self.stages(), **arguments)
        return list(self.made)


def test_only_what_is_not_fresh_is_made(tmp_path):
    chain = Chain(tmp_path)
    assert chain.run(last="two") == ["one", "two"]
    assert chain.run() == ["three"]
    assert (tmp_path / "three.txt").read_text() == "abc"
    assert chain.run() == []
    # Another argument in the middle makes the middle and what stands on it anew.
    chain.letters = "axc"
    assert chain.run() == ["two", "three"]
    assert (tmp_path / "three.txt").read_text() == "axc"
    # The same content again leaves what stands on it fresh.
    (tmp_path / "two.txt").unlink()
    assert chain.run() == ["two"]
    (tmp_path / "one.txt").write_text("?")
    assert chain.run() == ["one"]


def test_from_and_until(tmp_path):
    chain = Chain(tmp_path)
    with pytest.raises(InputError, match="before it is not fresh"):
        chain.run(first="two")
    chain.run()
    assert chain.run(first="two", last="two") == ["two"]
    assert chain.run(first="one") == ["one", "two", "three"]
    for wrong in ({"first": "four"}, {"last": "zero"}, {"first": "three", "last": "one"}):
        with pytest.raises(InputError, match=r"--(from|until)"):
            chain.run(**wrong)


def test_a_stage_that_fails_leaves_the_others_whole(tmp_path):
    chain = Chain(tmp_path)
    stages = chain.stages()

    def fail(folder):
        raise KeyboardInterrupt

    broken = [*stages[:2], Stage("three", stages[2].inputs, stages[2].needs, fail)]
    with pytest.raises(KeyboardInterrupt):
        run_stages(tmp_path, broken)
    assert set(json.loads((tmp_path / "run.json").read_text())) == {"one", "two"}
    chain.made.clear()
    assert chain.run() == ["three"]

"""A run knows what is fresh, resumes where it was killed, and says what it cannot do."""

import json
import os
import subprocess
import sys
import time

import pytest

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.workflows.stage_runner import Stage, run_stages


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


half = []


def write(path, text):
    with atomic_path(path) as temporary:
        temporary.write_text(text)


def half_made(folder, letter, *, fail):
    """A stage with a folder of its own, that keeps what is there already and may be killed after its first file."""

    def build(run):
        own = run / "own"
        (own / "first.txt").is_file() or write(own / "first.txt", letter)
        if fail:
            kept = atomic_path(own / "second.txt")
            kept.__enter__().write_text("hal")
            half.append(kept)  # a killed process leaves its temporary file
            raise KeyboardInterrupt
        write(own / "second.txt", (own / "first.txt").read_text() + "!")
        return [own / "first.txt", own / "second.txt"]

    run_stages(folder, [Stage("only", {"letter": letter}, (), build, "own")])


def test_a_killed_stage_goes_on_only_with_what_it_would_make_again(tmp_path):
    own = tmp_path / "own"
    with pytest.raises(KeyboardInterrupt):
        half_made(tmp_path, "a", fail=True)
    (own / "first.txt").write_text("kept")
    half_made(tmp_path, "a", fail=False)
    assert (own / "second.txt").read_text() == "kept!"
    assert not list(own.glob("*.part*")), "what a killed process was writing is swept away"
    # Other inputs: nothing of the old is taken over, neither from a killed stage …
    with pytest.raises(KeyboardInterrupt):
        half_made(tmp_path, "b", fail=True)
    half_made(tmp_path, "c", fail=False)
    assert (own / "second.txt").read_text() == "c!"
    # … nor from a finished one, nor files that somebody changed since.
    (own / "first.txt").write_text("changed")
    half_made(tmp_path, "c", fail=False)
    assert (own / "second.txt").read_text() == "c!"


def test_files_that_no_run_has_made_are_neither_removed_nor_read(tmp_path):
    half_made(tmp_path, "a", fail=False)
    strangers = [tmp_path / ".own.old" / "mine.txt", tmp_path / ".holiday.part1.rar", tmp_path / "own" / "notes.txt"]
    strangers += [tmp_path / "own" / ".draft-1.part.txt", tmp_path / "own" / "deep" / "first.txt"]
    for path in strangers:
        path.parent.mkdir(exist_ok=True)
        path.write_text("precious")
    half_made(tmp_path, "a", fail=False)
    for _ in range(3):
        with pytest.raises(InputError, match="is a file that no run has made"):
            half_made(tmp_path, "b", fail=False)
        assert all(path.read_text() == "precious" for path in strangers)
        first = next(path for path in sorted((tmp_path / "own").rglob("*")) if path in strangers)
        first.replace(tmp_path / f"moved-{strangers.index(first)}")
        strangers = [path if path != first else tmp_path / f"moved-{strangers.index(first)}" for path in strangers]
    half_made(tmp_path, "b", fail=False)
    assert (tmp_path / "own" / "second.txt").read_text() == "b!"
    assert all(path.read_text() == "precious" for path in strangers)


def test_a_forged_list_of_written_files_removes_nothing_elsewhere(tmp_path):
    half_made(tmp_path / "run", "a", fail=False)
    (tmp_path / "mine.txt").write_text("precious")
    (tmp_path / "run" / "link").symlink_to(tmp_path)
    forged = ["../../mine.txt", str(tmp_path / "mine.txt"), "../link/mine.txt", 7, None, "a\0b"]
    with open(tmp_path / "run" / "own" / ".written.jsonl", "a") as file:
        file.write("".join(json.dumps(name) + "\n" for name in forged) + '{"torn')
    half_made(tmp_path / "run", "b", fail=False)
    assert (tmp_path / "mine.txt").read_text() == "precious"
    assert (tmp_path / "run" / "own" / "second.txt").read_text() == "b!"


@pytest.mark.parametrize(
    "text", ["{", "[]", '"x"', '{"only": 3}', '{"only": {"key": "k", "files": []}}', "[" * 100_000, "\udcff", ""]
)
def test_a_record_that_is_none_is_named(tmp_path, text):
    half_made(tmp_path, "a", fail=False)
    (tmp_path / "run.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match="not the record of a run") as error:
        half_made(tmp_path, "a", fail=False)
    assert "\n" not in str(error.value)
    (tmp_path / "run.json").unlink()
    half_made(tmp_path, "a", fail=False)


def test_a_second_run_in_a_folder_is_refused_while_the_first_works(tmp_path):
    script = (
        "import sys, time; from pathlib import Path; from seasonscapes.workflows.stage_runner import Stage, run_stages\n"
        "def build(folder):\n    print('here', flush=True)\n    time.sleep(60)\n"
        "run_stages(Path(sys.argv[1]), [Stage('only', {'letter': 'a'}, (), build, 'own')])"
    )
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout.readline() == "here\n"
        start = time.perf_counter()
        with pytest.raises(InputError, match="another run is at work"):
            half_made(tmp_path, "a", fail=False)
        assert time.perf_counter() - start < 5.0
        process.kill()
    half_made(tmp_path, "a", fail=False)


def test_a_kill_between_any_two_steps_leaves_nothing_old(tmp_path, monkeypatch):
    """Each write and removal of the ledger is killed once, where the stage had been finished and damaged."""
    from seasonscapes.workflows import stage_runner

    real = {name: getattr(stage_runner, name) for name in ("_write", "_put", "_remove")}
    for killed in range(10):
        folder = tmp_path / str(killed)
        half_made(folder, "a", fail=False)
        (folder / "own" / "first.txt").write_text("damaged")
        count = [0]

        def step(name, *arguments, killed=killed, count=count):
            count[0] += 1
            if count[0] > killed:
                raise KeyboardInterrupt
            return real[name](*arguments)

        with monkeypatch.context() as patch:
            for name in real:
                patch.setattr(stage_runner, name, lambda *arguments, name=name: step(name, *arguments))
            try:
                half_made(folder, "a", fail=False)
            except KeyboardInterrupt:
                assert killed < 8
        half_made(folder, "a", fail=False)
        assert (folder / "own" / "second.txt").read_text() == "a!"
        assert json.loads((folder / "run.json").read_text())["only"]["files"].keys() == {
            "own/first.txt",
            "own/second.txt",
        }


def test_a_folder_that_no_run_has_made_is_left_alone(tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match="no run has made"):
        half_made(tmp_path, "a", fail=False)
    assert (tmp_path / "own" / "mine.txt").read_text() == "precious"

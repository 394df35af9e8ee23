"""Work that is cut off: full disks, Ctrl-C at any moment, readers that go away. Nothing half is left, and it is told."""

import os
import pickle
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from fault_harness import disk_with, half_files, judge, run_in, snapshot, with_flag
from fault_verbs import BASE, write_land

WORK = {
    "render png": ["render", *BASE["render"], "--sky", "hosek"],
    "render exr": ["render", *with_flag(BASE["render"], "--output", "out/a.exr"), "--sky", "hosek"],
    "sky png": ["sky", *BASE["sky"], "--sky", "hosek"],
    "sky exr": ["sky", *with_flag(BASE["sky"], "--output", "out/d.exr"), "--sky", "hosek"],
    "lit-texture png": ["lit-texture", *BASE["lit-texture"], "--sky", "hosek"],
    "irradiance tif": ["irradiance", *BASE["irradiance"], "--sky", "hosek", "--rays", "16"],
    "webcams png": ["webcams", *BASE["webcams"]],
    "path json": ["path", *BASE["path"]],
    "path map": ["path", *BASE["path"], "--map", "out/map.png"],
    "film frames": ["timelapse", *BASE["timelapse"], "--sky", "hosek"],
    "film": ["timelapse", *with_flag(BASE["timelapse"], "--output", "out/f.mp4"), "--sky", "hosek"],
    "evaluate figures": ["evaluate", *BASE["evaluate"], "--figures", "out/figures"],
    "evaluate table": ["evaluate", *BASE["evaluate"], "--table", "out/table.md"],
}


@pytest.fixture(scope="module")
def warm_land(tmp_path_factory):
    """A land whose terrain and coefficients are built already, so that only the outputs remain to be written."""
    folder = write_land(tmp_path_factory.mktemp("warm"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SEASONSCAPES_WORKSPACE", str(folder / "workspace"))
        yield folder


@pytest.mark.parametrize("kind", WORK)
def test_a_full_disk(warm_land, record_property, kind):
    tokens = [*WORK[kind], "--json"]
    done = run_in(warm_land, tokens)
    judge(record_property, done, "accept")
    assert not half_files(warm_land / "inside")
    shutil.rmtree(warm_land / "inside" / "out")
    with disk_with(60):
        outcome = run_in(warm_land, tokens)
    # The folder of the output may have been made; nothing lies in it.
    outcome.new = {name for name in outcome.new if not (warm_land / name).is_dir()}
    outcome.changed -= {"inside", "inside/out"}
    left = [path for path in (warm_land / "inside").rglob("out/**/*") if path.is_file()]
    judge(record_property, outcome, "refuse", names="space|large|written|out/")
    assert not left
    judge(record_property, run_in(warm_land, tokens), "accept")
    assert not half_files(warm_land / "inside")


def test_a_full_disk_below_the_workspace(own_land, record_property):
    with disk_with(1000):
        outcome = run_in(own_land, ["terrain", "s.toml", "--json"])
    judge(record_property, outcome, "refuse", names="space|large")
    assert not [name for name in outcome.new if name.startswith("workspace/") and "." in Path(name).name]
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), "accept")


# Presses Ctrl-C in its own process after so many seconds: the handler is there, imports and work are under way.
DRIVER = """
import os, signal, sys, threading
from seasonscapes.cli import main
timer = threading.Timer(float(sys.argv[1]), os.kill, (os.getpid(), signal.SIGINT))
timer.daemon = True  # work that is done sooner ends the process
timer.start()
sys.argv[1:] = sys.argv[2:]
sys.exit(main())
"""


def interrupted(folder: Path, seconds: float, tokens: list[str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", DRIVER, str(seconds), *tokens]
    return subprocess.run(command, cwd=folder / "inside", capture_output=True, text=True)


@pytest.mark.parametrize("seconds", [0.05, 0.15, 0.3, 0.6, 1.0, 1.6, 2.5, 4.0])
def test_ctrl_c_at_any_moment(warm_land, record_property, seconds):
    """During imports, terrain, tracing or writing: one line and exit code 130, or the work was done before."""
    tokens = ["render", *BASE["render"], "--sky", "hosek", "--size", "64x48"]
    tokens = [*with_flag(with_flag(tokens, "--size", "64x48"), "--spp", "64"), "--json"]
    before = set(snapshot(warm_land / "inside"))
    done = interrupted(warm_land, seconds, tokens)
    lines = [line for line in done.stderr.splitlines() if line.startswith("seasonscapes: ")]
    good = done.returncode in (0, 130) and "Traceback" not in done.stderr
    good &= len(lines) == (1 if done.returncode else 0)
    wrong = [] if good else ["traceback"]
    half = half_files(warm_land / "inside") + [n for n in set(snapshot(warm_land)) if ".part" in n]
    wrong += ["half file"] if half or (done.returncode and set(snapshot(warm_land / "inside")) - before) else []
    record_property("fault", {"cases": 1, "wrong": wrong})
    assert not wrong, (done.returncode, done.stdout, done.stderr)


def test_ctrl_c_waits_for_an_import(tmp_path, record_property):
    """A module whose import turns every exception into another one is imported to its end first."""
    (tmp_path / "fragile.py").write_text(
        "import time\ntry:\n    time.sleep(0.5)\nexcept BaseException:\n    raise ImportError('half done')\nDONE = True\n"
    )
    program = (
        "import os, signal, sys, threading, time\n"
        "from seasonscapes.commands.interruption import interruptible\n"
        "try:\n"
        "    with interruptible():\n"
        "        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "        import fragile\n"
        "        time.sleep(5)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', fragile.DONE)\n"
    )
    env = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=env, timeout=60)
    record_property("fault", {"cases": 1, "wrong": [] if done.stdout == "interrupted True\n" else ["traceback"]})
    assert done.stdout == "interrupted True\n", done.stderr


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
@pytest.mark.parametrize("where", ["full", "closed pipe"])
def test_output_that_nobody_can_take(warm_land, record_property, stream, where):
    tokens = ["sky", *with_flag(BASE["sky"], "--output", None), "--sky", "hosek", "--json"]
    if where == "full":
        target = os.open("/dev/full", os.O_WRONLY)
    else:
        reader, target = os.pipe()
        os.close(reader)
    other = {"stdout": "stderr", "stderr": "stdout"}[stream]
    command = [sys.executable, "-m", "seasonscapes", *tokens]
    streams = {stream: target, other: subprocess.PIPE}
    done = subprocess.run(command, cwd=warm_land / "inside", text=True, **streams)
    os.close(target)
    said = getattr(done, other)
    good = "Traceback" not in said and "Exception ignored" not in said
    good &= done.returncode == (0 if where == "closed pipe" else 2)
    record_property("fault", {"cases": 1, "wrong": [] if good else ["traceback"]})
    assert good, (done.returncode, said)


def test_a_fault_of_the_program_is_one_line_and_its_traceback_is_kept_for_who_asks(tmp_path, record_property):
    program = (
        "import sys\nimport seasonscapes.workflows.provenance as module\n"
        "def broken(path):\n    raise RuntimeError('a bolt is loose')\n"
        "module.provenance = broken\n"
        "from seasonscapes.cli import main\nsys.exit(main(['info', 'a.png', '--json']))\n"
    )
    for debug, wanted in (("", False), ("1", True)):
        env = {**os.environ, "SEASONSCAPES_DEBUG": debug}
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=env)
        assert done.returncode == 1
        assert "a bolt is loose" in done.stdout
        assert ("Traceback" in done.stderr) == wanted
        assert "this is a fault of seasonscapes" in done.stderr.splitlines()[-1]
    record_property("fault", {"cases": 2, "wrong": []})


def test_a_picture_that_cannot_fit_into_memory_is_refused_first(warm_land, record_property):
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (used + 6 * 2**30, before[1]))
    try:
        tokens = with_flag(["render", *BASE["render"]], "--size", "32768x32768")
        outcome = run_in(warm_land, [*tokens, "--json"])
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    judge(record_property, outcome, names="--size.*memory")


@pytest.mark.parametrize("kind", ["cut", "flipped", "empty", "text", "folder", "pickle"])
@pytest.mark.parametrize("suffix", [".npz", ".npz.json"])
def test_artefacts_that_were_damaged(own_land, record_property, kind, suffix):
    """Told in one line with the cure, or made anew; never believed, never a traceback."""
    tokens = ["terrain", "s.toml", "--json"]
    judge(record_property, run_in(own_land, tokens), "accept")
    (path,) = (p for p in (own_land / "workspace").rglob("terrain-*") if p.name.endswith(suffix))
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    damage = {
        "cut": path.read_bytes()[: len(content) // 2],
        "flipped": bytes(content),
        "empty": b"",
        "text": b"text\n",
        "pickle": pickle.dumps({"a": 1}),
    }
    if kind == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes(damage[kind])
    judge(record_property, run_in(own_land, tokens), "either")
    shutil.rmtree(own_land / "workspace")
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), "accept")

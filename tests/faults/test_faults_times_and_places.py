"""Times, places, lengths of time, sizes and shares as people write them: understood as written, or refused."""

import json

import pytest
from fault_harness import TIME, judge, run_in, with_flag
from fault_verbs import BASE

pytestmark = pytest.mark.fast

NO_TIMES = [
    "",
    " ",
    "noon",
    "2024",
    "2024-09",
    "2024-09-18",
    "2024-09-18T",
    "2024-09-18T10.30",
    "2024-09-18T10,5",
    "2024-09-18T10:30.5",
    "2024-09-18T1000.5",
    "2024-09-18T25:00Z",
    "2024-09-18T10:60Z",
    "2024-13-01T10:00Z",
    "2024-02-30T10:00Z",
    "2023-02-29T10:00Z",
    "18.09.2024 10:00",
    "09/18/2024 10:00",
    "2024-09-18 10:00 CEST",
    "2024-09-18T10:00+25:00",
    "2024-09-18T10:00+02.5",
    "2024-09-18T10:00ZZ",
    "2024-09-18X10:00Z",
    "٢٠٢٤-٠٩-١٨T١٠:٠٠Z",
    "0001-01-01T00:00+14:00",
    "9999-12-31T23:59-14:00",
    "1850-01-01T00:00Z",
    "2100-01-01T00:00Z",
    "-2024-09-18T10:00Z",
    "2024-09-18T10:00Z\n",
    "1e400",
    "T10:00",
    "x" * 5000,
]


@pytest.mark.parametrize("json", [[], ["--json"]], ids=["plain", "json"])
@pytest.mark.parametrize("text", NO_TIMES, ids=lambda text: ascii(text)[:24])
def test_no_times(land, record_property, text, json):
    expected = "either" if text.endswith("\n") else "refuse"  # blanks around a time are none of its business
    tokens = with_flag(with_flag(BASE["sky"], "--time", text), "--output", None)
    judge(record_property, run_in(land, ["sky", *tokens, "--sky", "hosek", *json]), expected)


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("2024-09-18T10:00Z", "2024-09-18T10:00:00Z"),
        ("2024-09-18t10:00z", "2024-09-18T10:00:00Z"),
        ("20240918T1000Z", "2024-09-18T10:00:00Z"),
        ("2024-09-18T12:00", "2024-09-18T10:00:00Z"),
        ("2024-09-18 12", "2024-09-18T10:00:00Z"),
        ("2024-09-18T12:00:00.25+02:00", "2024-09-18T10:00:00Z"),
        ("2024-09-18T12:00:00,25+0200", "2024-09-18T10:00:00Z"),
        ("2024-W38-3T10:00Z", "2024-09-18T10:00:00Z"),
    ],
)
def test_times_that_are_understood(land, record_property, text, utc):
    tokens = with_flag(with_flag(BASE["sky"], "--time", text), "--output", None)
    outcome = run_in(land, ["sky", *tokens, "--sky", "hosek", "--json"])
    judge(record_property, outcome, "accept")
    assert json.loads(outcome.out)["time_utc"] == utc


NO_PLACES = [
    *(
        "",
        "46.5",
        "46.5;8",
        "46,5;8,0",
        "46.5,8,1,2",
        "a,b",
        "91,8",
        "-91,8",
        "46.5,361",
        "46.5,-181",
        "nan,8",
        "46,nan",
    ),
    *("46,8,nan", "46,8,inf", "46,8,1e9", "46,8,-1e9", "46,8,+0", "46,8,+-5", "inf,8", "1e400,8", "46°,8°", "46.5 8"),
    *("²,³", "46,8,", ",,", "0x10,8", "x" * 5000, "46.5,8,+1e12"),
]


@pytest.mark.parametrize("text", NO_PLACES, ids=lambda text: ascii(text)[:20])
@pytest.mark.parametrize("verb", ["sky", "render", "path"])
def test_no_places(land, record_property, verb, text):
    tokens, flag = BASE[verb], "--via" if verb == "path" else "--at"
    tokens = [*with_flag(tokens, flag, text), *{"path": ["--via=46.552,7.982,+300"]}.get(verb, [])]
    tokens += [] if verb == "path" else ["--sky", "hosek", *(["--heading", "0"] if verb == "render" else [])]
    judge(record_property, run_in(land, [verb, *with_flag(tokens, "--output", None), "--json"]))


def test_a_place_is_the_same_with_a_blank_and_with_an_equals_sign(land, record_property):
    found = []
    for words in (["--at", "-43.6,-170.1,0"], ["--at=-43.6,-170.1,0"]):
        outcome = run_in(land, ["sky", *words, "--time", TIME, "--sky", "hosek", "--json"])
        judge(record_property, outcome, "either")
        found.append(outcome.out)
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("flag", "text"),
    [
        *(
            ("--every", text)
            for text in ("", "0s", "-1h", "1", "h", "9" * 400 + "s", "99999999999d", "1e9s", "²h", "nanh")
        ),
        *(("--smooth", text) for text in ("", "-1s", "9" * 400 + "d", "fast")),
        *(("--shard", text) for text in ("", "²/³", "0/3", "4/3", "1/0", "-1/3", "1/2/3", "1/" + "9" * 400)),
        *(
            ("--cluster", text)
            for text in ("", "local:²", "local:0", "local:-1", "local:" + "9" * 400, "cloud:3", "slurm:")
        ),
        *(("--cluster", text) for text in ("tcp://::::", "tcp://", "tcp://localhost:99999", "slurm:nowhere.toml")),
        *(("--size", text) for text in ("", "0x0", "-1x5", "1e9x1", "99999x99999", "²x³", "10", "10x", "10x10x10")),
        *(("--fps", text) for text in ("0", "-1", "1e9")),
        *(("--seed", text) for text in ("-1", "99999999999")),
        *(("--season", text) for text in ("", "winter")),
        *(("--look", text) for text in ("", "bright")),
        *(("--white-balance", text) for text in ("", "red")),
        *(("--exposure", text) for text in ("", "nan", "inf", "bright")),
        *(("--albedo", text) for text in ("", "x", "=", "2024-01-01=", "2024-02-30=a.npz", "2024-09-18=s.toml")),
        *(("--device", text) for text in ("", "tpu")),
        *(("--mesher", text) for text in ("", "delaunay")),
        *(("--atlas", text) for text in ("", "sphere")),
        *(("--sky", text) for text in ("", "purple", "s.toml", "/", ".")),
        *(("--turbidity", text) for text in ("-1", "0", "1e30")),
        *(("--visibility-km", text) for text in ("-1", "0")),
        *(("--ozone-du", text) for text in ("-1", "1e30")),
        *(("--cloudiness", text) for text in ("-0.1", "1.1")),
        *(("--camera", text) for text in ("", "north", "../south", "\x1b[31m")),
    ],
    ids=lambda text: ascii(text)[:20],
)
def test_values_that_mean_nothing(land, record_property, flag, text):
    tokens = [*with_flag(BASE["timelapse"], "--times", None), "--from", TIME, "--to", "2024-09-18T11:00Z"]
    judge(record_property, run_in(land, ["timelapse", *with_flag(tokens, flag, text), "--json"]))


@pytest.mark.parametrize("count", [40, 2_000])
def test_a_list_of_times_longer_than_a_file_name(land, record_property, count):
    tokens = with_flag(BASE["timelapse"], "--times", ",".join([TIME] * count))
    judge(record_property, run_in(land, ["timelapse", *tokens, "--season", "winter", "--json"]), names="season")

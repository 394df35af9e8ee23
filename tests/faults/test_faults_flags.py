"""Every verb and flag with words that do not fit: one line that names the flag, before anything is opened or written."""

import pytest
from fault_harness import judge, run_in, with_flag
from fault_verbs import BASE, JSON_VERBS, flags_of

pytestmark = pytest.mark.fast

NO_NUMBERS = {"INT": ("", "nan", "1.5", "²", "9" * 5000), "FLOAT": ("", "nan", "1e999", "²")}
# --far-m may be infinite.
NUMBERS = [
    (verb, flag, value)
    for verb in BASE
    for flag, kind in flags_of(verb).items()
    for value in NO_NUMBERS.get(kind, ())
    if not (flag == "--far-m" and value in ("inf", "1e999"))
]
REPEATABLE = ("--via", "--albedo", "--used", "--painted")
# What every verb refuses, whatever it does; `{}` is a flag of its own that wants a value.
WORDS = {
    "unknown flag": (["--bogus=1"], "Unknown option"),
    "unknown short flag": (["-x"], "Unknown option"),
    "a word too many": (["one", "two", "three"], "Unused Tokens"),
    "a flag without its value": (["{}"], "requires an argument"),
    "a flag twice": (["{}=a", "{}=b"], "multiple times"),
    "a NUL": (["{}=a\0b"], "NUL"),
    "endless": (["{}=" + "x" * 200_000], "too long"),
}


def short(value: object) -> str:
    text = str(value) or "empty"
    return text if len(text) < 24 else f"{text[:4]}…{len(text)}"


@pytest.mark.parametrize(("verb", "flag", "value"), NUMBERS, ids=short)
def test_no_number(land, record_property, verb, flag, value):
    json = ["--json"] if verb in JSON_VERBS else []
    judge(record_property, run_in(land, [verb, *with_flag(BASE[verb], flag, value), *json]), names=flag)


@pytest.mark.parametrize("json", [False, True], ids=["plain", "json"])
@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.parametrize("verb", BASE)
def test_words_that_do_not_fit(land, record_property, verb, kind, json):
    words, said = WORDS[kind]
    kinds = flags_of(verb)
    own = next((flag for flag in kinds if kinds[flag] != "INT" and flag not in (*REPEATABLE, *BASE[verb])), None)
    if own is None and "{}" in "".join(words):
        pytest.skip("the verb has no such flag")
    tokens = [*BASE[verb], *(word.format(own) for word in words)]
    if kind == "a flag without its value" and json:
        tokens = [*tokens[:-1], "--json", tokens[-1]]
    elif json:
        tokens.append("--json")
    said = said if not json or verb in JSON_VERBS else ""  # to `annotate` --json itself is unknown
    judge(record_property, run_in(land, [verb, *tokens]), names=said)


@pytest.mark.parametrize("json", [[], ["--json"]], ids=["plain", "json"])
@pytest.mark.parametrize("verb", ["rendr", "", "-", "--", "RENDER", "../render", "render;ls", "a\x1b[31m"], ids=repr)
def test_unknown_verbs(land, record_property, verb, json):
    judge(record_property, run_in(land, [verb, "s.toml", *json]))


@pytest.mark.parametrize("verb", [verb for verb in BASE if verb not in ("doctor", "demo")])
def test_nothing_but_the_verb(land, record_property, verb):
    judge(record_property, run_in(land, [verb, "--json"]))

"""Each work and each DOI that the tree cites is in the bibliography, each entry is cited and has one verdict."""

import re
import unicodedata
from pathlib import Path

from pybtex.database import Person

ROOT = Path(__file__).parents[1]
FOLDERS = ("seasonscapes", "sun_models", "tests", "benchmarks", "notebooks", "scenes", "data_sources")
DOI = re.compile(r"doi[.:/ ](?:org/)?(10\.\d{4,5}/[^\s,\"`]+)", re.IGNORECASE)
ENTRY = re.compile(r"^@(\w+)\{(\w+), (.*)\}$")
SURNAME = r"[A-ZÀ-Þ][\wÀ-ž’'-]+"
WORK = re.compile(rf"({SURNAME})(?:,? (?:&|and) (?:de )?{SURNAME}|, {SURNAME}| et al\.?)*,? \(?((?:1[89]|20)\d\d)\b")
# Words before a year that are no authors: standards, months, companies, formats, Python's None.
NO_AUTHORS = {"Almanac", "Atmosphere", "Before", "CIE", "GREEN", "GeoTIFF", "GmbH", "IAU", "JPEG", "Neutral", "None", "Perigee", "RGB", "WGCCRE"} | {
    "January", "February", "March", "April", "May", "June", "July", "August", "September", "October", "November", "December",
}  # fmt: skip


def bibliography():
    """Key and fields of each entry; every entry stands on one line."""
    lines = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8").splitlines()
    entries = [ENTRY.match(line) for line in lines if line.startswith("@")]
    assert all(entries)
    return {entry[2]: dict(re.findall(r"(\w+)=\{(.*?)\}(?=, \w+=|$)", entry[3])) for entry in entries if entry}


def cited_texts():
    """Name and text of every file that cites."""
    for path in (
        path for folder in FOLDERS for suffix in ("py", "toml", "md") for path in (ROOT / folder).rglob(f"*.{suffix}")
    ):
        if path != Path(__file__):
            yield path.name, path.read_text(encoding="utf-8")


def letters(text):
    """Lower-case ASCII letters of a name: accents removed, ligatures written out."""
    for letter, written in (("æ", "ae"), ("ø", "o"), ("þ", "th")):
        text = text.lower().replace(letter, written)
    return re.sub("[^a-z]", "", unicodedata.normalize("NFKD", text))


def surname_and_year(fields):
    """Last word of the first author's surname, in letters, and the year."""
    author = fields["author"].split(" and ")[0]
    surname = author if author.startswith("{") else str(Person(author).rich_last_names[-1])
    return letters(surname), fields["year"]


def works(text):
    """Surname, in letters, and year of each work that a text cites; comment marks of broken lines removed."""
    joined = re.sub(r"\n\s*#? ?", " ", text)
    return {(letters(match[1]), match[2]) for match in WORK.finditer(joined) if match[1] not in NO_AUTHORS}


def cited_dois():
    """DOI to the files that cite it."""
    found: dict[str, set[str]] = {}
    for name, text in cited_texts():
        for doi in DOI.findall(text):
            # Prose goes on behind a DOI: a full stop, a colon, or a bracket that was opened before it.
            doi = doi.rstrip(".:;*'")
            while doi.count(")") > doi.count("("):
                doi = doi[: doi.rindex(")")]
            found.setdefault(doi.lower(), set()).add(name)
    return found


def test_every_doi_is_in_the_bibliography():
    known = {fields["doi"].lower() for fields in bibliography().values() if "doi" in fields}
    cited = cited_dois()
    assert len(cited) > 50
    assert {doi: files for doi, files in cited.items() if doi not in known} == {}


def test_every_work_is_in_the_bibliography():
    known = {surname_and_year(fields) for fields in bibliography().values()}
    cited: dict[tuple[str, str], set[str]] = {}
    for name, text in cited_texts():
        for work in works(text):
            cited.setdefault(work, set()).add(name)
    assert len(cited) > 80
    assert {work: files for work, files in cited.items() if work not in known} == {}


def test_an_unknown_work_is_found():
    assert works("as in Nobody & Noone 1999.\n    # After Some\n    # et al. (2001)") == {
        ("nobody", "1999"),
        ("some", "2001"),
    }


def test_every_entry_is_cited():
    cited = set().union(*(works(text) for _, text in cited_texts()))
    pages = "".join(
        path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md") if path.name != "citations.md"
    )
    keys = {key for group in re.findall(r"\{cite:\w+\}`([\w,]+)`", pages) for key in group.split(",")}
    assert {
        key for key, fields in bibliography().items() if surname_and_year(fields) not in cited and key not in keys
    } == set()


def test_every_entry_has_one_verdict():
    page = (ROOT / "docs" / "developing" / "citations.md").read_text(encoding="utf-8")
    verdicts = re.findall(r"`([a-z]+\d{4,5})`", page.split("## Verdicts", 1)[1].split("\n## ", 1)[0])
    # The note on a DOI of the American Meteorological Society names an entry of its own list again.
    verdicts.remove("dubovik2002")
    assert sorted(verdicts) == sorted(bibliography())


def test_entries_are_whole_and_named_by_author_and_year():
    entries = bibliography()
    assert len(entries) > 100
    for key, fields in entries.items():
        assert {"author", "title", "year"} <= set(fields), key
        assert key.endswith(fields["year"]) or key == "iso15469", key
    dois = [fields["doi"].lower() for fields in entries.values() if "doi" in fields]
    assert len(dois) == len(set(dois))

"""Every DOI that the tree cites is in the bibliography, and the bibliography is well formed."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = ("seasonscapes", "sun_models", "tests", "benchmarks", "notebooks", "scenes")
DOI = re.compile(r"doi[.:/ ](?:org/)?(10\.\d{4,5}/[^\s,\"`]+)", re.IGNORECASE)
ENTRY = re.compile(r"^@(\w+)\{(\w+), (.*)\}$")


def bibliography():
    """Key and fields of each entry; every entry stands on one line."""
    lines = (ROOT / "docs" / "references.bib").read_text(encoding="utf-8").splitlines()
    entries = [ENTRY.match(line) for line in lines if line.startswith("@")]
    assert all(entries)
    return {entry[2]: dict(re.findall(r"(\w+)=\{(.*?)\}(?=, \w+=|$)", entry[3])) for entry in entries if entry}


def cited_dois():
    """DOI to the files that cite it."""
    found: dict[str, set[str]] = {}
    for path in (
        path for folder in FOLDERS for suffix in ("py", "toml", "md") for path in (ROOT / folder).rglob(f"*.{suffix}")
    ):
        if path != Path(__file__):
            for doi in DOI.findall(path.read_text(encoding="utf-8")):
                # Prose goes on behind a DOI: a full stop, a colon, or a bracket that was opened before it.
                doi = doi.rstrip(".:;*'")
                while doi.count(")") > doi.count("("):
                    doi = doi[: doi.rindex(")")]
                found.setdefault(doi.lower(), set()).add(path.name)
    return found


def test_every_doi_is_in_the_bibliography():
    known = {fields["doi"].lower() for fields in bibliography().values() if "doi" in fields}
    cited = cited_dois()
    assert len(cited) > 50
    assert {doi: files for doi, files in cited.items() if doi not in known} == {}


def test_entries_are_whole_and_named_by_author_and_year():
    entries = bibliography()
    assert len(entries) > 100
    for key, fields in entries.items():
        assert {"author", "title", "year"} <= set(fields), key
        assert key.endswith(fields["year"]) or key == "iso15469", key
    dois = [fields["doi"].lower() for fields in entries.values() if "doi" in fields]
    assert len(dois) == len(set(dois))

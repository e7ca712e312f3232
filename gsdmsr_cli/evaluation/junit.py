"""Writes the results of checks as JUnit XML, which CI systems show as tests."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

from gsdmsr_cli.evaluation.gates import Verdict
from gsdmsr_cli.evaluation.summary import Document, value_of


def junit(name: str, document: Document, verdicts: Sequence[Verdict]) -> str:
    """Return a suite with a test per verdict, and the aggregate as the suite's properties."""
    failures = str(sum(not verdict.passed for verdict in verdicts))
    counts = {"tests": str(len(verdicts)), "failures": failures, "errors": "0"}
    root = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(root, "testsuite", {"name": name, **counts})
    properties = ElementTree.SubElement(suite, "properties")
    aggregate = document["aggregate"]
    for metric in aggregate:
        entry = {"name": metric, "value": str(value_of(aggregate, metric))}
        ElementTree.SubElement(properties, "property", entry)
    for verdict in verdicts:
        names = {"classname": name, "name": verdict.name}
        case = ElementTree.SubElement(suite, "testcase", names)
        if not verdict.passed:
            ElementTree.SubElement(case, "failure", {"message": verdict.found})
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"

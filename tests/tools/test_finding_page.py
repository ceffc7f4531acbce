"""The page of findings holds what the rules say, and every kind that the code makes."""

import ast

import finding_page


def test_a_planted_rule_is_read():
    code = '''
def check(estimate):
    """Doubt a map that is wet.

    Parameters
    ----------
    estimate : of the map.
    """
    text = f"the map has {estimate} drops"
    yield doubt("wet-map", text, drops=1)
    text = "it is dry" + "; drive on"
    yield warning("dry-map", text)
    yield Finding("damp-map", DOUBT, f"{estimate}: dry it")
    stages.note("no-finding", drops=1)
'''
    (function,) = finding_page._functions(ast.parse(code))
    found = {rule.kind: (rule.severity, rule.text) for rule in finding_page._rules_of(function, "room.py")}
    assert found == {
        "wet-map": ("doubt", "the map has ... drops"),
        "dry-map": ("warning", "it is dry; drive on"),
        "damp-map": ("doubt", "...: dry it"),
    }


def test_kinds_of_all_rooms_are_on_the_page_with_what_to_do():
    kinds = {rule.kind for rule in finding_page.rules()} - {"anchor-x"}
    assert {"loose-links", "wheels-against-lidar", "clock-set-back", "free-space-violation", "not-localized"} <= kinds
    page, short = finding_page.page(), finding_page.short_form()
    paragraphs = {text.partition("\n")[0]: text for text in page.split("\n## ")[1:]}
    assert kinds | {"anchor-unplaced", "scans-outside-odometry"} <= paragraphs.keys()
    assert not kinds - short.keys()
    assert not short.keys() - paragraphs.keys()
    for kind, text in paragraphs.items():
        assert all(part in text for part in ("A ", "**To do**", ".py`")), kind
        assert "\n> " in text or kind in {"reader", "refused"}, kind  # Their words are others'.
    assert "Planted faults that only this kind names" in page
    assert "It is explained by [clock-set-back](#clock-set-back)" in page

"""The page about changed appearances is made from the results beside it."""

from docs import make_perturbation


def test_the_page_is_what_the_results_say():
    assert make_perturbation.page() == make_perturbation.PAGE.read_text(encoding="utf-8")

"""The frame of pages."""

from egvs.drawing.pages import keep_units_together


def test_no_line_of_a_page_begins_with_a_percent_sign() -> None:
    page = (
        '<style>a { width: 5 %; }</style><p title="4 %">93 % of <b>7.5 %</b>, 5 % 3</p><script>x = 7 % 2</script> 1 %'
    )
    assert keep_units_together(page) == (
        '<style>a { width: 5 %; }</style><p title="4 %">93\u00a0% of <b>7.5\u00a0%</b>, 5\u00a0% 3</p>'
        "<script>x = 7 % 2</script> 1 %"
    )


def test_number_and_metres_stay_on_one_line() -> None:
    assert keep_units_together("<h1>pole k04, 3 m up; 5 mounts</h1>") == "<h1>pole k04, 3\u00a0m up; 5 mounts</h1>"

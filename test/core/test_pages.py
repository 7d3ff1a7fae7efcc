"""Markdown as it is printed."""

from gapr_core.pages import markdown


def test_a_markdown_table_has_a_head_a_rule_and_a_line_for_each_row():
    assert markdown.table(["a", "b"], [[1, "x"], [2.5, "y"]]) == "| a | b |\n| --- | --- |\n| 1 | x |\n| 2.5 | y |"


def test_a_cell_of_a_table_holds_no_html_and_no_end_of_it():
    assert markdown.row(["a|b", "<script>\nx", 1]) == r"| a\|b | \<script> x | 1 |"

"""The page by keyboard and for screen readers: the focus stays where it was, and each row and control has its words."""

from pathlib import Path

import pytest

from tests.report.browser import Browser

pytestmark = pytest.mark.slow

FOCUSED = "document.activeElement.textContent"
CURRENT = "document.getElementById(document.getElementById('tree').getAttribute('aria-activedescendant'))"


def test_the_focus_stays_on_the_control_that_was_used(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tab.ask("document.querySelector('[role=tab][aria-selected=true]').focus()")
        for name in ("Objects4", "Attachments1"):
            tab.press("ArrowRight")
            assert tab.ask(FOCUSED) == name
        assert tab.ask("document.querySelectorAll('[role=tab][tabindex=\"0\"]').length") == 1
        assert tab.ask("document.getElementById('panel').getAttribute('aria-labelledby')") == "tab-attachments"
        tab.ask("document.querySelector('.panel .moment').focus()")
        moment = tab.ask(FOCUSED)
        tab.ask("document.activeElement.click()")
        assert tab.ask(FOCUSED) == moment
        assert tab.ask("`e${pycrormPage.event}`") == moment
        tab.ask("pycrormPage.panels.open('failures')")
        assert tab.ask("document.activeElement.id") == "panel"  # the control is gone


def test_the_tree_is_walked_from_the_current_row_which_is_announced(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tab.ask("document.getElementById('tree').focus()")
        assert tab.ask(f"{CURRENT}.getAttribute('aria-label')").startswith("TransportAction, SUCCEEDED, took ")
        tab.press("ArrowUp")
        spoken = tab.ask(f"{CURRENT}.getAttribute('aria-label')")
        assert spoken.startswith("MoveTCPMotion, FAILED, IKError, took ")
        assert "l_gripper_tool_frame cannot reach" in spoken
        assert tab.ask("pycrormPage.selected.reason") == "IKError"
        tab.press("ArrowLeft")
        assert tab.ask("pycrormPage.selected.name") == "PickUpAction"
        tab.press("ArrowLeft")
        assert tab.ask(f"{CURRENT}.getAttribute('aria-expanded')") == "false"
        tab.press("ArrowLeft")
        assert tab.ask("pycrormPage.selected.name") == "root"
        tab.press("ArrowRight")
        assert tab.ask("pycrormPage.selected.name") == "ParkArmsAction"
        places = f"['aria-level', 'aria-posinset', 'aria-setsize'].map((each) => {CURRENT}.getAttribute(each))"
        assert tab.ask(places) == ["2", "1", "5"]


def test_every_control_has_a_name_that_is_no_sign(chrome: Browser, pages: dict[str, Path]) -> None:
    with chrome.open(pages["plan"]) as tab:
        tree = tab.call("Accessibility.getFullAXTree")["nodes"]
        roles = ("button", "slider", "tab", "treeitem")
        names = [
            (each["role"]["value"], each["name"]["value"])
            for each in tree
            if not each["ignored"] and each["role"]["value"] in roles
        ]
        assert {role for role, _ in names} == set(roles)
        assert [each for each in names if not any(map(str.isalnum, each[1]))] == []


def test_a_table_of_episodes_is_sorted_by_keys_and_announces_it(chrome: Browser, overview: Path) -> None:
    with chrome.open(overview) as tab:
        tab.ask("document.querySelector('th button').focus()")
        assert tab.ask("document.querySelector('th').getAttribute('aria-sort')") == "descending"
        tab.ask("document.activeElement.click()")
        assert tab.ask("document.querySelector('th').getAttribute('aria-sort')") == "ascending"
        assert tab.ask(FOCUSED) == "episode ▴"


@pytest.mark.soak_on(800)
@pytest.mark.parametrize("width", [420, 800, 1400])
def test_the_table_of_episodes_is_in_sight_without_scrolling(chrome: Browser, overview: Path, width: int) -> None:
    with chrome.open(overview, width=width) as tab:
        heads = "[...document.querySelectorAll('#episodes th')].map((each) => each.textContent)"
        assert tab.ask(heads) == [
            "episode ▾",
            "started (UTC)",
            "status",
            "took",
            "nodes",
            "failed",
            "robots",
            "description",
        ]
        assert tab.ask("document.documentElement.scrollWidth") == width
        robots = "[...document.querySelectorAll('#episodes tbody td:nth-child(7)')].map((each) => each.textContent)"
        assert tab.ask(robots) == ["courier, other", "pr2", "pr2"]
        texts = tab.ask("[...document.querySelectorAll('#success text')].map((each) => each.textContent)")
        assert [each for each in texts if "_" in each] == ["relative_x (m)", "relative_y (m)"]
        edges = """[...document.querySelectorAll('#episodes td, #episodes th')].map((each) => {
          const { left, right } = each.getBoundingClientRect();
          return [left, right];
        })"""
        assert all(0 <= left <= right <= width for left, right in tab.ask(edges))
        assert tab.ask("document.querySelector('#episodes').scrollHeight") == tab.ask(
            "document.querySelector('#episodes').clientHeight"
        )
        if width == 1400:
            assert tab.ask("document.querySelector('#episodes tbody').getBoundingClientRect().bottom") < 900
        assert tab.problems() == []


def test_episodes_without_a_page_name_the_reason_and_what_still_runs_has_no_chart(
    chrome: Browser, overview: Path
) -> None:
    with chrome.open(overview) as tab:
        assert tab.ask("document.getElementById('trend').textContent").startswith("Success")
        assert "no page" not in tab.ask("document.getElementById('episodes').textContent")
        tab.ask(
            "new pycrormOverview.constructor({ title: '', total: 3, episodes: pycrormOverview.episodes"
            ".map((each) => ({ ...each, status: 'RUNNING', page: null })) })"
        )
        assert tab.ask("document.getElementById('trend').textContent") == ""
        text = tab.ask("document.getElementById('episodes').textContent")
        assert text.count(" no page") == 4
        assert text.endswith(
            "3 older episodes have no page here. One of them gets a page of its own by pycrorm report 3"
        )

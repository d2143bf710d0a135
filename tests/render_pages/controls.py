"""The controls of the pages, worked as a visitor does."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.render_pages.browser import Browser

STATUS = "document.querySelector('textarea').value"
NUMBER_BOXES = "document.querySelectorAll('input.mantine-NumberInput-input')"


def show(browser: Browser, url: str) -> None:
    """Open a page and wait until it is drawn."""
    browser.open(url)
    browser.wait_until("document.querySelector('canvas[data-engine]').width > 300 && document.body.innerText.includes('Flower')")
    browser.run("document.querySelectorAll('.mantine-Notification-root button').forEach(button => button.click())")


def centre_of(browser: Browser, element: str) -> tuple[float, float]:
    """Where to click on an element, once it rests there and nothing covers it."""
    x, y = browser.wait_until(
        f"""(element => {{
            const r = element.getBoundingClientRect(), place = [r.left + r.width / 2, r.top + r.height / 2];
            const rests = String(place) === window.lastPlace;
            window.lastPlace = String(place);
            return rests && element.contains(document.elementFromPoint(...place)) && place;
        }})({element})"""
    )
    return x, y


def button(text: str) -> str:
    """JavaScript for the button that says so."""
    return f"Array.from(document.querySelectorAll('button')).find(each => each.innerText.trim() == {json.dumps(text)})"


def type_number(browser: Browser, box: int, text: str) -> None:
    """Put another number into one of the boxes beside the sliders."""
    browser.run(f"{NUMBER_BOXES}[{box}].focus(), {NUMBER_BOXES}[{box}].select()")
    browser.ask("Input.insertText", text=text)
    browser.key("Enter", 13)

"""`visible` makes the control characters of recorded text visible, so that none of them drives a terminal.

Names, descriptions, messages and values come from programs and users. An ESC, or its C1 form, begins a command of
the terminal (colours, titles, links, the clipboard), and a bidirectional control reorders what stands around it. Every
place that shows recorded text as text uses this function: the consoles of the command, the answers to agents, and the
report; the page's scripts have the same rule (`plain` in `report/web/dom.js`). JSON has escapes of its own.
"""

import re

_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def visible(text: str, *, kept: str = "\t\n") -> str:
    """Return the text with a sign for each control character but those in `kept`.

    >>> visible("a\x1b[31mb\u202e")
    'a␛[31mb<U+202E>'
    """
    return _CONTROL.sub(lambda each: each[0] if each[0] in kept else _sign(ord(each[0])), text)


def _sign(code: int) -> str:
    return chr(0x2400 + code) if code < 0x20 else f"<U+{code:04X}>"


def without_formula(text: str) -> str:
    """Return a text that a spreadsheet takes for a text: an apostrophe comes before one that begins as a formula.

    >>> without_formula("=HYPERLINK(A1)"), without_formula("milk")
    ("'=HYPERLINK(A1)", 'milk')
    """
    return f"'{text}" if text[:1] in _FORMULA else text


_FORMULA = frozenset("=+-@\t\r\n\uff1d\uff0b\uff0d\uff20")
"""The characters with which a formula begins, full-width ones too, and those that spreadsheets skip before one."""


def escaped_json(document: str) -> str:
    """Return a JSON document that means the same and has no control character but line ends between its values.

    >>> escaped_json('{"name": "\x9b31m"}')
    '{"name": "\\\\u009b31m"}'
    """
    return _CONTROL.sub(lambda each: each[0] if each[0] in "\t\n" else f"\\u{ord(each[0]):04x}", document)

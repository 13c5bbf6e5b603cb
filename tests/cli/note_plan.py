"""A plan that takes three notes, for tests of the command."""

NOTES_PLAN = """
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    async def perform(self): ...

async def plan():
    '''Take three notes.'''
    for text in "abc":
        await NoteActionPerformable(text).perform()
"""

"""Hold the text of plans that fail, exit, never suspend, or pass values that cannot be recorded."""

PLANS = '''
import asyncio, math, os, sys
from dataclasses import dataclass
from pycrorm_async.plan import ActionAbstract, NavigateActionPerformable, PlanFailure, simulated_robot
from pycrorm_async.world import BulletWorld, Object, ObjectType, Pose

@dataclass
class NoteActionPerformable(ActionAbstract):
    text: str
    weight: float = 0.0
    async def perform(self):
        return None

async def plan():
    """Take a note."""
    await NoteActionPerformable("a").perform()

def sync():
    pass

async def greedy(memory, world):
    pass

async def raises():
    await NoteActionPerformable("a").perform()
    raise ValueError("the milk is sour")

async def fails():
    await NoteActionPerformable("a").perform()
    raise PlanFailure("the milk is out of reach")

async def cancels():
    await NoteActionPerformable("a").perform()
    asyncio.current_task().cancel()
    await asyncio.sleep(1)

async def nan_in_a_pose():
    await NoteActionPerformable("a").perform()
    with BulletWorld(), simulated_robot:
        Object("pr2", ObjectType.ROBOT)
        await NavigateActionPerformable(Pose([math.nan, 0, 0])).perform()

async def unrecordable():
    await NoteActionPerformable("a").perform()
    await NoteActionPerformable("b", weight="heavy").perform()

async def reserved():
    @dataclass
    class BadActionPerformable(ActionAbstract):
        robot_state: str
        async def perform(self):
            return None
    await NoteActionPerformable("a").perform()
    await BadActionPerformable("x").perform()

async def twins():
    @dataclass
    class NoteAction(ActionAbstract):
        async def perform(self):
            return None
    await NoteActionPerformable("a").perform()
    await NoteAction().perform()

async def list_for_a_pose():
    await NoteActionPerformable("a").perform()
    NavigateActionPerformable([0.6, 0.4, 0])

async def two_episodes(memory):
    async with memory.episode(description="outer"):
        await NoteActionPerformable("a").perform()
        async with memory.episode(description="inner"):
            pass

async def leaves():
    await NoteActionPerformable("a").perform()
    sys.exit(5)

async def opening(memory):
    pass

async def endless():
    """Never suspends."""
    while True:
        await NoteActionPerformable("a").perform()
        os.write(1, b".")
'''

"""How it is asked: ordinary sessions, data frames that go around the mapped classes, and questions with a name."""

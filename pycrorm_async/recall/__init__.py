"""Recall past situations: which remembered actions are most like this one, and how did they end?"""

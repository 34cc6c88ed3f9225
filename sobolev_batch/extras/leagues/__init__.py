"""Leagues: methods ranked over all objects of a study, by distance and by cost; studies against earlier ones.

In: the tables of stores. Out: tables with confidence intervals and tests, as data and as text.
"""

"""Workflows: functions of values that load data, call the stages and keep artefacts, with progress reports.

The command line, notebooks and scripts all call these functions. They take and return values, report progress through
a callback (`seasonscapes.progress`), log what a user should know through the logger ``seasonscapes``, and raise the
exceptions of `seasonscapes.errors` for mistakes in the user's input.
"""

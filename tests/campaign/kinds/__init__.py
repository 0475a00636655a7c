"""Kinds of cases: every module here that holds a `KIND` is one."""

"""Every query and every change of state. The caller owns the transaction and wakes workers after it.

A function that writes takes its mission's row first, so that on every backend the writers of one mission
go one after the other: no deadlock, no lost update, events in the order of their commits.
"""

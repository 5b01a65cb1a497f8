"""Proof that a change of the code changed no behaviour: two commits give the same outputs on the same inputs.

`python -m benchmarks.unchanged BASE [HEAD]` exports both commits, runs the same commands with each, and compares
their outputs. `__main__` is the command line; `trees` exports commits; `items` lists the commands; `recorder` runs
them inside an exported tree; `comparison` compares outputs; `suite` compares the tests of both commits; `structure`
counts lines, files, methods and words.
"""

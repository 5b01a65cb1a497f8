"""Proof that a change of the code changed no behaviour: two commits give the same outputs on the same inputs.

`python -m benchmarks.unchanged BASE [HEAD]` exports both commits, runs the same commands with each, and compares what
they print and write. `__main__` is the command line; `trees` exports commits; `items` lists what is run; `recorder`
runs it inside an exported tree; `comparison` compares outputs; `suite` compares the tests of both commits;
`structure` counts lines, files, methods and words.
"""

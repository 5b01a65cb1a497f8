"""Python programs that run on robots. They need Python 3.8 or newer; programs that use a middleware need its binding.

They are copied to robots as one file (`fieldkit.remote.agent`), so this package imports no other package of fieldkit.
"""

"""Python programs that run on robots. They need Python 3.8, the standard library and the binding of a middleware.

They are copied to robots as one file (`fieldkit.remote.agent`), so this package imports no other package of fieldkit.
"""

"""The command line, one command a file, each of which adds itself to the parser. Heavy imports wait
until needed.
"""

"""Files: those of a run, written whole or not at all and read with clear errors, and those of the
package.
"""

"""Machine code without a C compiler: CasADi's functions by way of LLVM, loops around them by numba."""

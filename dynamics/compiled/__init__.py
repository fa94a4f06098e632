"""Machine code without a C compiler: CasADi's functions by LLVM, and loops around them by Numba."""

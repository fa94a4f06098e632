/* Small dense linear algebra. CasADi's matrices are column-major. */

static double dot_row(const double *matrix, int row, const double *v) {
    double sum = 0;
    for (int j = 0; j < N; j++) sum += matrix[row + N * j] * v[j];
    return sum;
}

static inline int cholesky(const double *a, factor l) {
    for (int i = 0; i < N; i++)
        for (int j = 0; j <= i; j++) {
            double sum = a[i + N * j];
            for (int k = 0; k < j; k++) sum -= l[i][k] * l[j][k];
            if (i == j) {
                if (!(sum > 0)) return 0;
                l[i][i] = 1 / sqrt(sum);
            } else
                l[i][j] = sum * l[j][j];
        }
    return 1;
}

static inline void cholesky_solve(const factor l, int n, double *b) {
    for (int i = 0; i < n; i++) {
        for (int k = 0; k < i; k++) b[i] -= l[i][k] * b[k];
        b[i] *= l[i][i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int k = i + 1; k < n; k++) b[i] -= l[k][i] * b[k];
        b[i] *= l[i][i];
    }
}

/* Cholesky factor of compliance[list][list], size count. */
static void factor_stuck(const double compliance[N][N], const int *list, int count, factor l) {
    for (int i = 0; i < count; i++)
        for (int j = 0; j <= i; j++) {
            double sum = compliance[list[i]][list[j]];
            for (int k = 0; k < j; k++) sum -= l[i][k] * l[j][k];
            l[i][j] = i == j ? 1 / sqrt(sum) : sum * l[j][j];
        }
}

/* Solve the symmetric positive definite system compliance[list][list] f = b in place, size count. */
static void solve_stuck(const double compliance[N][N], const int *list, int count, double *b) {
    factor l;
    factor_stuck(compliance, list, count, l);
    cholesky_solve(l, count, b);
}

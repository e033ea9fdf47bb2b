// Clusters that a work-group holds: rows, their order of elimination and where atoms stand come from tables, and
// numbers lie in GLOBAL memory. All work-items come here with the same arguments. With one work-item these are loops.
//
// rows_cluster  first row, first atom, first level of each cluster
// rows_row      of each row: function, first slot, first parameter, how its atoms are gathered (0 as stored, 1 relative
//               to the first, 2 with cells that are given, too), first entry, first earlier entry, flags (1 of
//               velocities, 2 is summed), number of its moving target or -1, its first cell
// rows_number   of each row: target, scale, period
// rows_slot     of each slot (an atom of a row): the atom in its cluster, its row
// rows_entry    of each entry of the matrix: its two rows in the order of elimination, first product, first update
// A gradient stands behind its value: that of slot p of row k at 3*p+k+1.

#define ROW(k, what) rows_row[9*(k)+(what)]
#define ENTRY(e, what) rows_entry[4*(e)+(what)]
#define PLACE(p) (3*rows_slot[2*(p)])

// Values and gradients at x + d (moved) or at x, of rows first to last; those of velocities `half_way` before `time`.
DEVICE void rows_evaluate(ROWS int cluster, mixed time, mixed half_way, int moved, GLOBAL const mixed* x, GLOBAL const mixed* d, GLOBAL mixed* result) {
    for (int k = rows_cluster[3*cluster]+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) {
        int begin = ROW(k, 1), end = ROW(k+1, 1), how = ROW(k, 3), rolls = ROW(k, 6) & 1, size = 3*(end-begin), s = PLACE(begin);
        GLOBAL mixed* r = rows_place+6*begin;
        mixed share = rolls ? (mixed) 0.5 : (mixed) 1;
        for (int p = begin; p < end; p++) {
            int a = PLACE(p), at = 3*(p-begin);
            XYZ {
                r[at+c] = how ? x[a+c]-x[s+c] : x[a+c];
                if (moved) r[at+c] += share*(how ? d[a+c]-d[s+c] : d[a+c]);
                if (rolls) r[size+at+c] = moved ? d[a+c] : (mixed) 0;
            }
            if (how == 2) ROWS_SHIFT((r+at), (rows_cells+ROW(k, 8)+at))
        }
        rows_function(ROW(k, 0), r, rows_parameter+ROW(k, 2), rows_knots[0]+(rolls ? time-half_way : time), result+3*begin+k);
    }
}

// L and U of J = A(now) M^-1 A(there)^T level by level, and L y = off in the same sweep; then U y. An entry (i, j) holds
// J_ij and J_ji; what is eliminated before is gathered, so that no two work-items write to one place.
DEVICE void rows_solve(ROWS int cluster, int factors, GLOBAL const mixed* now, GLOBAL const mixed* there, GLOBAL const mixed* w) {
    int levels = rows_cluster[3*cluster+2], top = rows_cluster[3*cluster+5], level = levels;
    do {
        int first = rows_level[level];
        if (factors)
            for (int e = ROW(first, 4)+LOCAL_ID; e < ROW(rows_level[level+1], 4); e += LOCAL_SIZE) {
                int i = ENTRY(e, 0), j = ENTRY(e, 1);
                mixed up = 0, low = 0;
                for (int u = ENTRY(e, 2); u < ENTRY(e+1, 2); u++) {
                    int p = rows_product[2*u], q = rows_product[2*u+1], a = 3*p+i+1, b = 3*q+j+1;
                    mixed m = w[rows_slot[2*p]];
                    up += m*ROWS_DOT((now+a), (there+b));
                    low += m*ROWS_DOT((now+b), (there+a));
                }
                mixed whole = fabs(up);
                for (int u = ENTRY(e, 3); u < ENTRY(e+1, 3); u++) {
                    int p = rows_update[3*u], q = rows_update[3*u+1];
                    mixed inverse = rows_pivot[rows_update[3*u+2]];
                    up -= rows_lower[p]*inverse*rows_upper[q];
                    low -= rows_lower[q]*inverse*rows_upper[p];
                }
                if (i == j) rows_pivot[i] = fabs(up) <= ROWS_PIVOT*whole ? (mixed) 0 : 1/up;
                else {rows_upper[e] = up; rows_lower[e] = low;}
            }
        for (int k = first+LOCAL_ID; k < rows_level[level+1]; k += LOCAL_SIZE) {
            mixed y = rows_off[k];
            for (int u = ROW(k, 5); u < ROW(k+1, 5); u++) {
                int e = rows_earlier[u], m = ENTRY(e, 0);
                y -= rows_lower[e]*rows_pivot[m]*rows_answer[m];
            }
            rows_answer[k] = y;
        }
        SYNC_THREADS;
    } while (++level < top);
    do {
        level--;
        for (int k = rows_level[level]+LOCAL_ID; k < rows_level[level+1]; k += LOCAL_SIZE) {
            mixed y = rows_answer[k];
            for (int e = ROW(k, 4)+1; e < ROW(k+1, 4); e++) y -= rows_upper[e]*rows_answer[ENTRY(e, 1)];
            rows_answer[k] = rows_pivot[k]*y;
        }
        SYNC_THREADS;
    } while (level > levels);
}

// d -= M^-1 A^T y, atom by atom.
DEVICE void rows_push(ROWS int cluster, GLOBAL const mixed* there, GLOBAL mixed* d, GLOBAL const mixed* w) {
    int base = rows_cluster[3*cluster+1];
    for (int a = base+LOCAL_ID; a < rows_cluster[3*cluster+4]; a += LOCAL_SIZE) {
        mixed s[3] = {0, 0, 0};
        for (int u = rows_atom[a]; u < rows_atom[a+1]; u++) {
            int p = rows_touch[u], k = rows_slot[2*p+1];
            XYZ s[c] += rows_answer[k]*there[3*p+k+1+c];
        }
        XYZ d[3*(a-base)+c] -= w[a-base]*s[c];
    }
}

// How far rows are off at x + d; returns a row that is off more than it may be by its number + 1, 0 if there is none, and
// the negative where a row is not finite.
DEVICE int rows_measure(ROWS int cluster, mixed h, mixed time, GLOBAL const mixed* x, GLOBAL const mixed* d) {
    int first = rows_cluster[3*cluster];
    if (LOCAL_ID == 0) {scratch[0] = 0; scratch[1] = 0;}
    rows_evaluate(ROWS_PASS cluster, time, h/2, 1, x, d, rows_now);
    SYNC_THREADS;
    for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) {
        int begin = ROW(k, 1), rolls = ROW(k, 6) & 1;
        mixed wanted = rows_number[3*k], period = rows_number[3*k+2], along = 0, reach = 0;
        if (ROW(k, 7) >= 0) wanted = rows_moving(rows_knots, ROW(k, 7), rolls ? time-h/2 : time, 0);
        mixed off = rows_now[3*begin+k]-(rolls ? h*wanted : wanted);
        if (period > 0) off -= period*rint(off/period);
        rows_off[k] = off;
        for (int q = 3*begin+k+1; q < 3*ROW(k+1, 1)+k+1; q++) along += rows_now[q]*rows_there[q];
        if (!ROW(k, 3)) for (int p = begin; p < ROW(k+1, 1); p++) XYZ reach += fabs(rows_there[3*p+k+1+c]*x[PLACE(p)+c]);
        mixed allowed = tolerance*rows_number[3*k+1]*(rolls ? (mixed) 0.0625 : (mixed) 1)+ROWS_ROUNDING*reach;
        if (!(fabs(off) <= allowed && along > 0)) scratch[0] = k+1;
        if (!(fabs(off) < ROWS_FAR)) scratch[1] = k+1;
    }
    SYNC_THREADS;
    int missed = (int) scratch[0], lost = (int) scratch[1];
    SYNC_THREADS;
    return lost ? -lost : missed;
}

DEVICE void positions_large(ROWS int cluster, mixed h, mixed time, GLOBAL const mixed* x, GLOBAL mixed* d, GLOBAL const mixed* w) {
    int first = rows_cluster[3*cluster], turn = 0;
    rows_evaluate(ROWS_PASS cluster, time-h, 0, 0, x, d, rows_there);
    for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) rows_sum[k] = 0;
    SYNC_THREADS;
    int missed = rows_measure(ROWS_PASS cluster, h, time, x, d);
    do {
        rows_solve(ROWS_PASS cluster, turn%ROWS_CHORD == 0, rows_now, rows_there, w);
        if (missed > 0) {
            rows_push(ROWS_PASS cluster, rows_there, d, w);
            for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) rows_sum[k] += rows_answer[k];
        }
        SYNC_THREADS;
        missed = rows_measure(ROWS_PASS cluster, h, time, x, d);
    } while ((missed > 0) & (++turn < ROWS_TURNS));   // one way out, and one pass at least: barriers are inside
    if (missed && LOCAL_ID == 0) {
        int k = (missed > 0 ? missed : -missed)-1;
        FAIL(ROWS_FIRST_LARGE+k, rows_off[k])
    }
    for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) if (ROW(k, 6) & 2) ROWS_ADD(rows_sums, rows_lost, ROWS_FIRST_LARGE+k, rows_sum[k]/h)
    SYNC_THREADS;
}

DEVICE void velocities_large(ROWS int cluster, mixed rate, mixed time, GLOBAL const mixed* x, GLOBAL mixed* v, GLOBAL const mixed* w) {
    int first = rows_cluster[3*cluster], pass = 0;
    rows_evaluate(ROWS_PASS cluster, time, 0, 0, x, x, rows_there);
    SYNC_THREADS;
    do {
        for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) {
            int begin = ROW(k, 1), rolls = ROW(k, 6) & 1;
            mixed off = 0;
            if (ROW(k, 7) >= 0) off = -rate*rows_moving(rows_knots, ROW(k, 7), time, rolls ? 0 : 1);
            else if (rolls) off = -rate*rows_number[3*k];
            if (rate != 0) off += rate*rows_drift(ROW(k, 0), rows_place+6*begin, rows_parameter+ROW(k, 2), rows_knots[0]+time);
            for (int p = begin; p < ROW(k+1, 1); p++) off += ROWS_DOT((rows_there+3*p+k+1), (v+PLACE(p)));
            rows_off[k] = off;
        }
        SYNC_THREADS;
        rows_solve(ROWS_PASS cluster, pass == 0, rows_there, rows_there, w);
        rows_push(ROWS_PASS cluster, rows_there, v, w);
        if (rate != 0) for (int k = first+LOCAL_ID; k < rows_cluster[3*cluster+3]; k += LOCAL_SIZE) if (ROW(k, 6) & 2) ROWS_ADD(rows_sums, rows_lost, ROWS_FIRST_LARGE+k, rows_answer[k])
        SYNC_THREADS;
    } while (++pass < 2);
}

//! The filters of PNG: a row becomes its differences from what a decoder has already.
//!
//! Source: "Portable Network Graphics (PNG) Specification" (W3C, third edition, 2025), section 9.

/// Filters rows, one after the other, and keeps its memory from row to row.
#[derive(Debug, Default)]
pub(crate) struct RowFilter {
    best: Vec<u8>,
    other: Vec<u8>,
}

impl RowFilter {
    /// A filter's number and the row filtered by it. Of filters 1 to 4 the one is chosen that
    /// gives the least sum of absolute differences (section 12.7 of the specification). `row` and
    /// the row above, `above`, have equally many bytes, and at least one pixel of `pixel_bytes`
    /// bytes.
    pub(crate) fn filter(&mut self, above: &[u8], row: &[u8], pixel_bytes: usize) -> &[u8] {
        let mut least = u64::MAX;
        self.best.resize(1 + row.len(), 0);
        self.other.resize(1 + row.len(), 0);
        // Equal sums: the first. A flat row has the sum 0 at once.
        for (number, filter) in [(2, up as Filter), (1, sub), (3, average), (4, paeth)] {
            self.other[0] = number;
            filter(above, row, pixel_bytes, &mut self.other[1..]);
            let sum = self.other[1..].chunks(256).map(sum_of_differences).sum();
            if sum < least {
                least = sum;
                std::mem::swap(&mut self.best, &mut self.other);
                if sum == 0 {
                    break;
                }
            }
        }
        &self.best
    }

    /// The same for the first row of a band, by filter 1, which needs no row above: that is
    /// another band's, and may change after this one was compressed.
    pub(crate) fn filter_first(&mut self, row: &[u8], pixel_bytes: usize) -> &[u8] {
        self.best.resize(1 + row.len(), 0);
        self.best[0] = 1;
        sub(&[], row, pixel_bytes, &mut self.best[1..]);
        &self.best
    }
}

type Filter = fn(&[u8], &[u8], usize, &mut [u8]);

/// The sum of at most 256 differences, each of which stands for a number from -128 to 127.
fn sum_of_differences(bytes: &[u8]) -> u64 {
    bytes.iter().map(|&byte| u32::from(byte.cast_signed().unsigned_abs())).sum::<u32>().into()
}

fn up(above: &[u8], row: &[u8], _: usize, out: &mut [u8]) {
    for ((out, &byte), &b) in out.iter_mut().zip(row).zip(above) {
        *out = byte.wrapping_sub(b);
    }
}

fn sub(_: &[u8], row: &[u8], pixel_bytes: usize, out: &mut [u8]) {
    out[..pixel_bytes].copy_from_slice(&row[..pixel_bytes]);
    for ((out, &byte), &a) in out[pixel_bytes..].iter_mut().zip(&row[pixel_bytes..]).zip(row) {
        *out = byte.wrapping_sub(a);
    }
}

fn average(above: &[u8], row: &[u8], pixel_bytes: usize, out: &mut [u8]) {
    for ((out, &byte), &b) in out[..pixel_bytes].iter_mut().zip(row).zip(above) {
        *out = byte.wrapping_sub(b / 2);
    }
    let left = row.iter().zip(&above[pixel_bytes..]);
    for ((out, &byte), (&a, &b)) in out[pixel_bytes..].iter_mut().zip(&row[pixel_bytes..]).zip(left)
    {
        // The mean, rounded down, without a wider number.
        *out = byte.wrapping_sub((a & b) + ((a ^ b) >> 1));
    }
}

fn paeth(above: &[u8], row: &[u8], pixel_bytes: usize, out: &mut [u8]) {
    // Where nothing stands to the left, the predictor is what stands above.
    up(&above[..pixel_bytes], &row[..pixel_bytes], pixel_bytes, &mut out[..pixel_bytes]);
    let left = row.iter().zip(&above[pixel_bytes..]).zip(above);
    for ((out, &byte), ((&a, &b), &c)) in
        out[pixel_bytes..].iter_mut().zip(&row[pixel_bytes..]).zip(left)
    {
        *out = byte.wrapping_sub(predict(a, b, c));
    }
}

/// That of left, above and upper left which is nearest to left + above - upper left; of equally
/// near ones the first. In eight bits, so that a vector has many of them.
///
/// Source: Versari, "The fast JPEG XL and FPNGE encoders" (2022): where the upper left lies
/// between the others, its distance is the difference of theirs, and else it is the largest.
fn predict(a: u8, b: u8, c: u8) -> u8 {
    let (to_a, to_b) = (b.abs_diff(c), a.abs_diff(c));
    let is_between = (a < c) == (c < b);
    let to_c = if is_between { to_a.abs_diff(to_b) } else { 255 };
    if to_a <= to_b && to_a <= to_c {
        a
    } else if to_b <= to_c {
        b
    } else {
        c
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The predictor as the specification has it.
    fn predict_by_the_book(a: u8, b: u8, c: u8) -> u8 {
        let p = i32::from(a) + i32::from(b) - i32::from(c);
        let [to_a, to_b, to_c] = [a, b, c].map(|byte| (p - i32::from(byte)).abs());
        if to_a <= to_b && to_a <= to_c {
            a
        } else if to_b <= to_c {
            b
        } else {
            c
        }
    }

    #[test]
    fn the_predictor_is_that_of_the_specification() {
        for a in 0..=255 {
            for b in 0..=255 {
                for c in 0..=255 {
                    assert_eq!(predict(a, b, c), predict_by_the_book(a, b, c), "{a} {b} {c}");
                }
            }
        }
    }

    /// Undoes a filter as the specification says.
    fn unfilter(above: &[u8], filtered: &[u8], pixel_bytes: usize) -> Vec<u8> {
        let (filter, bytes) = (filtered[0], &filtered[1..]);
        let mut row: Vec<u8> = Vec::new();
        for (i, &byte) in bytes.iter().enumerate() {
            let left = |of: &[u8]| i.checked_sub(pixel_bytes).map_or(0, |i| of[i]);
            let (a, b, c) = (left(&row), above[i], left(above));
            let predicted = match filter {
                0 => 0,
                1 => a,
                2 => b,
                3 => u16::midpoint(a.into(), b.into()) as u8,
                4 => predict_by_the_book(a, b, c),
                _ => panic!("there is no filter {filter}"),
            };
            row.push(byte.wrapping_add(predicted));
        }
        row
    }

    #[test]
    fn a_filtered_row_is_found_again() {
        let mut rng = fastrand::Rng::with_seed(1);
        let (mut chosen, mut filter) = ([0; 5], RowFilter::default());
        for pixel_bytes in [3, 6] {
            for width in [1, 2, 7, 40] {
                for slope in 0..8 {
                    let mut row = |at: usize| -> Vec<u8> {
                        let noise = 1 << (slope % 8);
                        let byte = |i| (i * slope + at) as u8;
                        (0..width * pixel_bytes).map(|i| byte(i) ^ rng.u8(..noise)).collect()
                    };
                    let (above, row) = (row(3), row(5));
                    let filtered = filter.filter(&above, &row, pixel_bytes);
                    assert_eq!(unfilter(&above, filtered, pixel_bytes), row);
                    chosen[usize::from(filtered[0])] += 1;
                }
            }
        }
        assert!(chosen[1..].iter().all(|&count| count > 0), "{chosen:?}");
    }
}

//! Letters of five by seven dots, for words on clothes.

/// Words printed on chests.
const WORDS: [&str; 12] =
    ["WAVE", "NORTH", "RIVER", "SOUL", "MOTO", "CLUB 7", "SURF", "LUNA", "ZEBRA", "HELLO", "JAZZ", "PEAK"];

/// Returns the rows from above, the leftmost dot in bit 4.
fn rows(letter: char) -> [u8; 7] {
    match letter {
        'A' => [14, 17, 17, 31, 17, 17, 17],
        'B' => [30, 17, 17, 30, 17, 17, 30],
        'C' => [14, 17, 16, 16, 16, 17, 14],
        'E' => [31, 16, 16, 30, 16, 16, 31],
        'F' => [31, 16, 16, 30, 16, 16, 16],
        'H' => [17, 17, 17, 31, 17, 17, 17],
        'I' => [14, 4, 4, 4, 4, 4, 14],
        'J' => [7, 2, 2, 2, 2, 18, 12],
        'K' => [17, 18, 20, 24, 20, 18, 17],
        'L' => [16, 16, 16, 16, 16, 16, 31],
        'M' => [17, 27, 21, 21, 17, 17, 17],
        'N' => [17, 25, 25, 21, 19, 19, 17],
        'O' => [14, 17, 17, 17, 17, 17, 14],
        'P' => [30, 17, 17, 30, 16, 16, 16],
        'R' => [30, 17, 17, 30, 20, 18, 17],
        'S' => [15, 16, 16, 14, 1, 1, 30],
        'T' => [31, 4, 4, 4, 4, 4, 4],
        'U' => [17, 17, 17, 17, 17, 17, 14],
        'V' => [17, 17, 17, 17, 17, 10, 4],
        'W' => [17, 17, 17, 21, 21, 27, 17],
        'Z' => [31, 1, 2, 4, 8, 16, 31],
        '7' => [31, 1, 2, 4, 4, 8, 8],
        _ => [0; 7],
    }
}

/// Returns the coverage (0 or 1) of the word `which` at `x` metres to the reader's right and `y` metres up from its
/// centre; the word is `width_m` wide.
pub(crate) fn word_at(which: u8, width_m: f32, x: f32, y: f32) -> f32 {
    let word = WORDS[usize::from(which) % WORDS.len()];
    let columns = word.chars().count() * 6 - 1;
    let dot_m = width_m / columns as f32;
    let (column, row) = ((x / dot_m + columns as f32 / 2.0).floor(), (3.5 - y / dot_m).floor());
    if !(0.0..columns as f32).contains(&column) || !(0.0..7.0).contains(&row) {
        return 0.0;
    }
    let (letter, bit) = (column as usize / 6, column as usize % 6);
    let line = word.chars().nth(letter).map_or(0, |letter| rows(letter)[row as usize]);
    if bit < 5 && line >> (4 - bit) & 1 == 1 { 1.0 } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_words_have_their_letters_and_nothing_lies_outside() {
        for (which, word) in (0u8..).zip(WORDS) {
            assert!(word.chars().all(|c| c == ' ' || rows(c) != [0; 7]), "{word}");
            assert!(word_at(which, 0.2, 0.11, 0.0).abs() < f32::EPSILON);
            let inked: f32 = (0..400).map(|i| word_at(which, 0.2, i as f32 * 0.0005 - 0.1, 0.0)).sum();
            assert!(inked > 20.0, "{word}");
        }
    }
}

//! Short labels in pictures.

use ndarray::ArrayViewMut3;

/// Number of rows of a letter; # is a dot.
const HEIGHT: usize = 7;

/// Letters of labels such as `l=3 m=-2`, 5 dots wide.
const LETTERS: [(char, [&str; HEIGHT]); 8] = [
    ('0', [" ### ", "#   #", "#   #", "#   #", "#   #", "#   #", " ### "]),
    ('1', ["  #  ", " ##  ", "  #  ", "  #  ", "  #  ", "  #  ", " ### "]),
    ('2', [" ### ", "#   #", "    #", "   # ", "  #  ", " #   ", "#####"]),
    ('3', [" ### ", "#   #", "    #", "  ## ", "    #", "#   #", " ### "]),
    ('-', ["     ", "     ", "     ", " ####", "     ", "     ", "     "]),
    ('=', ["     ", "     ", "#### ", "     ", "#### ", "     ", "     "]),
    ('l', [" ##  ", "  #  ", "  #  ", "  #  ", "  #  ", "  #  ", " ### "]),
    ('m', ["     ", "     ", "## # ", "# # #", "# # #", "# # #", "# # #"]),
];

/// Writes a label into the upper left corner of a picture, with square dots of `dot` pixels and brightness `ink`. Unknown characters become spaces. The
/// label is clipped to the picture.
pub fn write(picture: &mut ArrayViewMut3<'_, f32>, label: &str, dot: usize, ink: f32) {
    let margin = 2 * dot;
    for (place, letter) in label.chars().enumerate() {
        let rows = LETTERS.iter().find(|(known, _)| *known == letter).map(|(_, rows)| rows);
        for (row, dots) in rows.into_iter().flatten().enumerate() {
            for (column, _) in dots.chars().enumerate().filter(|(_, c)| *c == '#') {
                let [top, left] = [margin + row * dot, margin + (6 * place + column) * dot];
                for y in top..top + dot {
                    for x in left..left + dot {
                        (0..3).for_each(|c| picture.get_mut([y, x, c]).into_iter().for_each(|value| *value = ink));
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    #[test]
    fn letters_are_drawn_where_they_fit() {
        let mut picture = Array3::from_elem((12, 9, 3), 1.0);
        write(&mut picture.view_mut(), "1-", 1, 0.0);
        let row = |y: usize| (0..9).map(|x| if picture[[y, x, 0]] == 0.0 { '#' } else { ' ' }).collect::<String>();
        // The second letter is clipped at the border.
        assert_eq!((row(2), row(5), row(8)), ("    #    ".to_owned(), "    #    ".to_owned(), "   ###   ".to_owned()));
        let ink = picture.iter().filter(|value| **value == 0.0).count();
        assert_eq!(ink, 3 * 10);
        assert!(LETTERS.iter().all(|(_, rows)| rows.iter().all(|row| row.len() == 5)));
    }
}

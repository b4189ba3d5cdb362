// Stores four pixels of a column that lie in the image, of which the column has `left` more, from index o on. No bindings, no entry points;
// the including kernel declares `store`. Written out, as an index that varies would keep the pixels in memory.
fn keep_four(row: i32, o: i32, left: i32, pixels: mat4x3f) {
    if left > 0 {
        store(o, pixels[0]);
    }
    if left > 1 {
        store(o + row, pixels[1]);
    }
    if left > 2 {
        store(o + 2 * row, pixels[2]);
    }
    if left > 3 {
        store(o + 3 * row, pixels[3]);
    }
}
